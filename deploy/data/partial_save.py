"""Save what a recording holds so far, beside the recording: nothing more is lost if the process is killed."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from brakeline.errors import BadData
from brakeline.safety.model.dataset import Dataset

log = logging.getLogger("brakeline.collect")

EVERY = 20.0  # s between two saves


class PartialSave:
    """Saves a growing data set to `path`, in a thread: the caller has to keep its period."""

    def __init__(self, path: Path) -> None:
        """Prepare to save. An earlier partial data set at `path` moves aside."""
        self._path, self._pool = path, ThreadPoolExecutor(1, "partial-save")
        self._last: Future[None] | None = None
        self._at = -EVERY
        if path.exists():
            aside = path.replace(path.with_suffix(".earlier" + path.suffix))
            log.warning("an earlier flight was cut off: its data are now in %s", aside)

    def offer(self, data: Callable[[], Dataset]) -> None:
        """Save what `data` returns, unless the last save was a moment ago or is still under way."""
        if time.monotonic() - self._at < EVERY or not (self._last is None or self._last.done()):
            return
        self._at = time.monotonic()
        self._last = self._pool.submit(self._save, data)

    def _save(self, data: Callable[[], Dataset]) -> None:
        try:
            data().save(self._path)
        except (OSError, BadData) as error:
            log.error("the flight is in memory only, because its part is not saved: %s", error)

    def finish(self) -> None:
        """Wait for a save that is under way."""
        self._pool.shutdown()

    def remove(self) -> None:
        """Delete the partial data set: the whole one is stored."""
        self._path.unlink(missing_ok=True)


def partial_path(path: Path) -> Path:
    """Return the path for the part of a recording that is not finished yet.

    >>> partial_path(Path("data/flown.safetensors")).as_posix()
    'data/flown.part.safetensors'
    """
    return path.with_name(f"{path.stem}.part{path.suffix}")
