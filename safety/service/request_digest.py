"""What names a question, so that an answer can say which one it is to."""

from __future__ import annotations

import hashlib

SIZE = 16  # bytes


def digest(question: bytes) -> bytes:
    """Of a batch of requests, nonce included, as it crosses the bus."""
    return hashlib.sha256(question).digest()[:SIZE]
