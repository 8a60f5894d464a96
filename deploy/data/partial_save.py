"""Save a recording again and again while it grows, so that a killed process loses little."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from brakeline.errors import BadData
from brakeline.safety.model.dataset import Dataset

log = logging.getLogger("brakeline.collect")


class PartialSave:
    """Saves a growing data set to a file, in a thread, so that a control period of the caller never waits for it."""

    def __init__(self, path: Path) -> None:
        """Prepare to save to `path`. Rename an earlier partial data set there to a name that no file has yet."""
        self._path, self._pool = path, ThreadPoolExecutor(1, "partial-save")
        self._last: Future[None] | None = None
        if path.exists():
            names = (path.with_suffix(f".earlier{number}{path.suffix}") for number in ("", *range(2, 10_000)))
            aside = path.replace(next(name for name in names if not name.exists()))
            log.warning("an earlier flight was cut off: its data are now in %s", aside)

    def offer(self, data: Callable[[], Dataset]) -> None:
        """Save what `data` returns, unless the last save is still under way."""
        if self._last is None or self._last.done():
            self._last = self._pool.submit(self._save, data)

    def _save(self, data: Callable[[], Dataset]) -> None:
        try:
            data().save(self._path)
        except (OSError, BadData) as error:
            log.error("the flight so far is in memory only, because it could not be saved: %s", error)

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
