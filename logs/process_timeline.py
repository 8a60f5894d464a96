"""Compute the timeline of a run's processes: when each was alive, silent or restarted, and its warnings."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import asdict, dataclass, field

from brakeline.logs.episode_stats import Figures
from brakeline.logs.metrics import SILENT
from brakeline.messaging import brakeline_pb2 as pb

MOST_LIVES = 500
MOST_LINES = 200  # log lines: the first 100 and the last 100
MOST_BINS = 240
LEVELS = ("WARNING", "ERROR")


@dataclass
class Life:
    """A period in which a process sent a Health message at least every `SILENT` seconds."""

    process: str
    start: float  # s since the Unix epoch
    end: float
    run: int = field(repr=False)  # identifies the start of the process
    goodbye: bool = False  # the process announced its end
    restart: bool = False  # the process was started again, not only silent before


class ProcessTimeline:
    """Collects Health messages, log lines and the times of steps."""

    def __init__(self) -> None:
        self.lives: list[Life] = []
        self.lines: list[Figures] = []
        self.last_lines: deque[Figures] = deque(maxlen=MOST_LINES // 2)
        self.begin: float | None = None
        self.width = 1.0  # s of a bin
        self.steps: Counter[int] = Counter()  # steps by bin
        self._latest: dict[str, Life] = {}

    def health(self, health: pb.Health, received: int) -> None:
        """Add a sign of life that was received at this time, ns."""
        name, now, run = health.process, received * 1e-9, health.header.run
        life = self._latest.get(name)
        if life is not None and life.run == run and (now - life.end <= SILENT or len(self.lives) >= MOST_LIVES):
            life.end = max(life.end, now)
        elif len(self.lives) < MOST_LIVES:
            restart = life is not None and life.run != run
            life = self._latest[name] = Life(name, now, now, run, restart=restart)
            self.lives.append(life)
        if life is not None and life.run == run:
            life.goodbye = health.last

    def line(self, line: pb.LogLine, received: int) -> None:
        """Add a log line that was received at this time, ns."""
        if line.level in LEVELS:
            row = {"t": received * 1e-9, "process": line.process, "level": line.level, "text": line.text[:300]}
            if len(self.lines) < MOST_LINES // 2:
                self.lines.append(row)
            else:
                self.last_lines.append(row)

    def step(self, received: int) -> None:
        """Count a step that was received at this time, ns."""
        now = received * 1e-9
        if self.begin is None:
            self.begin = now
        number = int((now - self.begin) / self.width)
        self.steps[number] += 1
        if len(self.steps) > MOST_BINS:
            self.width *= 2.0
            coarse: Counter[int] = Counter()
            for place, count in self.steps.items():
                coarse[place // 2] += count
            self.steps = coarse

    def figures(self) -> Figures:
        """Return the timeline; times in s since the Unix epoch; `steps`: (start of the bin, steps per second)."""
        begin = self.begin or 0.0
        return {
            "lives": [{name: value for name, value in asdict(life).items() if name != "run"} for life in self.lives],
            "lines": [*self.lines, *self.last_lines],
            "bin_s": self.width,
            "steps": [(begin + place * self.width, self.steps[place] / self.width) for place in sorted(self.steps)],
        }
