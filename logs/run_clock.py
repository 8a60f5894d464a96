"""Place the times at which a recorder or a viewer received messages on one axis without jumps."""

from __future__ import annotations

REORDERED = 10**9  # ns by which a message may be earlier than the one before, in a log without a steady clock
PAUSE = 60 * 10**9  # ns: a recorder receives its own signs of life each second, so a longer pause is a jump


class RunClock:
    """Turns times of receipt [ns] into times on one axis. The axis begins at the first time.

    The times of one recorder are steady (`messaging/steady_clock.py`). Those of another recorder may be hours apart, so
    the axis goes on from the latest time where a recorder begins a file, and leaves out the pause between the files.

    Attributes:
        jumps: s by which the clock of an earlier version's recorder jumped.
    """

    def __init__(self) -> None:
        self.jumps: list[float] = []
        self._offset = self._latest = 0
        self._begins, self._steady = False, True

    def begin_file(self) -> None:
        """Note that the next time is the first one of a file."""
        self._begins, self._steady = self._latest > 0, False

    def trust(self) -> None:
        """Note that the recorder of this file had a steady clock."""
        self._steady = True

    def at(self, received: int) -> int:
        """Return the time on the axis [ns]."""
        at = received + self._offset
        if self._begins:
            self._offset += self._latest - at
            self._begins, at = False, self._latest
        elif self._latest and not self._steady and not -REORDERED < at - self._latest < PAUSE:
            self.jumps.append((at - self._latest) * 1e-9)
            self._offset += self._latest - at
            at = self._latest
        self._latest = max(self._latest, at)
        return at
