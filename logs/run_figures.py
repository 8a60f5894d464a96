"""The figures that a run saves beside its log."""

from __future__ import annotations

from pathlib import Path

from brakeline.errors import BadText
from brakeline.messaging.structured_text import parse_json

FIGURES = "figures.json"


def unlogged_messages(log: Path) -> int:
    """Return how many published messages the last start of a run counted that its log lacks; 0 if it did not count.

    Only the run knows about the last messages of a process: its last sign of life may be missing from the log, too.

    Args:
        log: a file of the log.
    """
    try:
        missing = parse_json((log.parent / FIGURES).read_bytes())["log_messages"]["missing"]
    except (OSError, BadText, LookupError, TypeError):
        return 0
    return missing if isinstance(missing, int) else 0
