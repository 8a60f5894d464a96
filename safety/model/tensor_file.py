"""Named arrays and what is said of them, as the bytes of a safetensors file: nothing in it can be executed.

What is said stands in one metadata entry, as JSON with sorted keys: several entries would come in another order each
time, and the same content is to give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from brakeline.errors import BadTensors


def pack(tensors: Mapping[str, NDArray[Any]], entry: str, about: Mapping[str, Any]) -> bytes:
    """`about` must be what JSON can hold."""
    return save(_contiguous(tensors), {entry: json.dumps(about, sort_keys=True)})


def content(tensors: Mapping[str, NDArray[Any]]) -> bytes:
    """The arrays alone, to make a hash of."""
    return save(_contiguous(tensors))


def unpack(payload: bytes, entry: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays, and what the metadata entry says of them.

    Raises:
        BadTensors: it is no such file, or has no such entry; the message says which.
    """
    try:
        about = json.loads(_metadata(payload)[entry])
        tensors = load(payload)
    except KeyError as error:
        raise BadTensors(f"there is no {error} in it") from error
    except (SafetensorError, ValueError, TypeError, AttributeError) as error:
        raise BadTensors(str(error)) from error
    if not isinstance(about, dict):
        raise BadTensors(f"its {entry!r} is no object")
    return tensors, about


def has_entry(payload: bytes, entry: str) -> bool:
    """Is it a safetensors file with that metadata entry?"""
    try:
        return entry in _metadata(payload)
    except (ValueError, TypeError, AttributeError):
        return False


def _contiguous(tensors: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}


def _metadata(payload: bytes) -> dict[str, str]:
    size = int.from_bytes(payload[:8], "little")
    found: dict[str, str] = json.loads(payload[8 : 8 + size]).get("__metadata__", {})
    return found
