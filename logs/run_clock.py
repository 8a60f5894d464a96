"""Place the times at which a recorder received messages on one axis without jumps."""

from __future__ import annotations


class RunClock:
    """Turns times of receipt [ns] into times on one axis. The axis begins at the first time.

    The times of one recorder are steady (`messaging/steady_clock.py`). Those of another recorder may be hours apart, so
    the axis goes on from the latest time where a recorder begins a file, and leaves out the pause between the files.
    """

    def __init__(self) -> None:
        self._offset = self._latest = 0
        self._begins = False

    def begin_file(self) -> None:
        """Note that the next time is the first one of a file."""
        self._begins = self._latest > 0

    def at(self, received: int) -> int:
        """Return the time on the axis [ns]."""
        if self._begins:
            self._offset, self._begins = self._latest - received, False
        at = received + self._offset
        self._latest = max(self._latest, at)
        return at
