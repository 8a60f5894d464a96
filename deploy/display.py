"""What a person sees of a run: a live table while it lasts, and a summary at its end."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from deploy.launch import View
from logs.report import show

REFRESH = 0.5  # s between two looks at the figures
PLAIN = 10.0  # s between two lines where there is no terminal
LINES = 5  # of warnings shown


class Display:
    """Call it with the view of a run, as often as you like; it redraws when there is something to see."""

    def __init__(self, console: Console, steps: int) -> None:
        self.console = console
        self._bar = Progress(
            TextColumn("steps"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        )
        self._task = self._bar.add_task("steps", total=steps)
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._last = -1e9
        self._said = 0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, view: View) -> None:
        spacing = REFRESH if self._live is not None else PLAIN
        if time.monotonic() - self._last < spacing and not view.ending:
            return
        self._last = time.monotonic()
        figures = view.metrics.figures()
        self._bar.update(self._task, completed=figures["steps"])
        if self._live is not None:
            self._live.update(live(view, figures, self._bar), refresh=True)
        else:
            self.console.print(line(figures), highlight=False)


def line(figures: dict[str, Any]) -> str:
    """The figures that matter most, for a log."""
    learners = figures["learners"].values()
    updates = sum(learner["updates_per_s"] for learner in learners)
    return (
        f"steps {figures['steps']}  episodes {figures['episodes']}  goals {figures['goals']}  "
        f"collisions {figures['collisions']}  interventions {share(figures['interventions'], figures['steps'])}  "
        f"{sum(learner['steps_per_s'] for learner in learners):.0f} steps/s  {updates:.0f} updates/s"
    )


def live(view: View, figures: dict[str, Any], bar: Progress) -> RenderableType:
    """The whole picture: progress, the learning, the safety, the processes, the latest warnings."""
    parts: list[RenderableType] = [bar, _run(figures), _processes(view)]
    if view.lines:
        parts.append("\n".join(f"[yellow]{text}[/]" for text in list(view.lines)[-LINES:]))
    return Panel(Group(*parts), title=f"brakeline: {view.folder}", subtitle="^C ends every process in order")


def _run(figures: dict[str, Any]) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 3, 0, 0))
    episodes, steps = figures["episodes"], figures["steps"]
    times, trip = figures["decision_ms"], figures["round_trip_ms"]
    table.add_row("episodes", str(episodes), "goals", share(figures["goals"], episodes))
    color = "green" if figures["collisions"] == 0 else "bold red"
    table.add_row(
        "collisions",
        f"[{color}]{figures['collisions']}[/]",
        "interventions",
        f"{share(figures['interventions'], steps)} ({figures['failsafes']} failsafe, {figures['fallbacks']} no answer)",
    )
    if times:
        table.add_row("decide p50 / p99", _pair(times), "round trip p50 / p99", _pair(trip) if trip else "-")
    contained = figures["containment"]
    table.add_row(
        "outside predicted set", share(contained["violations"], contained["steps"]), "mean reward", _mean(figures)
    )
    for robot, learner in figures["learners"].items():
        table.add_row(
            f"learner {robot}",
            f"{learner['steps_per_s']:.0f} steps/s, {learner['updates_per_s']:.0f} updates/s",
            "losses",
            f"critic {learner['critic_loss']:.3f}, actor {learner['actor_loss']:.3f}; "
            f"lost {learner['missing']}, twice {learner['duplicates']}",
        )
    return table


def _mean(figures: dict[str, Any]) -> str:
    return "-" if figures["mean_reward"] is None else f"{figures['mean_reward']:.1f}"


def _pair(times: dict[str, Any]) -> str:
    return f"{times['p50']:.2f} / {times['p99']:.2f} ms"


def _processes(view: View) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("process", "state", "restarts"):
        table.add_column(column, style="dim" if column != "process" else "")
    for child in view.children:
        state = "[green]runs[/]" if child.alive else "done" if child.finished else "[red]down[/]"
        table.add_row(child.place.name, state, str(child.restarts))
    return table


def share(count: int, of: int) -> str:
    """A count with its share."""
    return f"{count} ({count / of:.1%})" if of else str(count)


def summary(console: Console, figures: dict[str, Any]) -> None:
    """The end of a run: what happened, and where it is."""
    console.print(show({name: value for name, value in figures.items() if name != "topics"}))
    lost = sum(topic["missing"] for topic in figures["topics"].values())
    console.print(f"messages lost: {lost}; restarts: {figures['restarts'] or 'none'}")
    console.print(f"log:    {figures['log']}")
    for path in figures["policies"]:
        console.print(f"policy: {path}")
