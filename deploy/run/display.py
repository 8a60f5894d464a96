"""Show a run on the console: a live table during the run and a summary at its end."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from brakeline.deploy.run.run_view import RunView
from brakeline.logs.report import show
from brakeline.logs.tube_stats import stated

REFRESH = 0.5  # s between updates of the table
PLAIN = 10.0  # s between lines without a terminal
LINES = 5  # shown warnings


class Display:
    """Shows the view of a run. You can call it at any rate: it limits the redrawing itself."""

    def __init__(self, console: Console, steps: int) -> None:
        self.console = console
        self._bar = Progress(
            TextColumn("steps"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        )
        self._task = self._bar.add_task("steps", total=steps)
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._last = -1e9 if self._live is not None else time.monotonic()
        self._last_phase = ""  # the last printed phase, without a terminal

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, view: RunView) -> None:
        if self._live is None and (phase := run_phase(view)) != self._last_phase:
            self._last_phase = phase
            self.console.print(phase, markup=False)
        spacing = REFRESH if self._live is not None else PLAIN
        if time.monotonic() - self._last < spacing and not (view.ending and self._live is not None):
            return
        self._last = time.monotonic()
        figures = view.metrics.figures()
        learned = sum(learner["steps"] for learner in figures["learners"].values())
        self._bar.update(self._task, completed=max(figures["steps"], learned))  # a resumed run has earlier steps
        if self._live is not None:
            self._live.update(live(view, figures, self._bar), refresh=True)
        else:
            self.console.print(line(figures))


def run_phase(view: RunView) -> str:
    """Return what the run is doing now."""
    if view.ending:
        return "ending every process in order"
    known = view.metrics.processes.copy()
    starting = [child.spec.name for child in view.processes if child.spec.name not in known and not child.finished]
    if starting:
        return f"starting {', '.join(starting)}"
    if not any(stats.steps for stats in view.metrics.actors.copy().values()) and view.config.actors:
        return "waiting for the first step"
    return "driving" if view.config.policy else "driving and learning" if view.config.actors else "learning from logs"


def line(figures: dict[str, Any]) -> str:
    """Format the main figures as one line."""
    learners = figures["learners"].values()
    updates = sum(learner["updates_per_s"] for learner in learners)
    steps = max(figures["steps"], sum(learner["steps"] for learner in learners))  # offline training has no actor
    return (
        f"steps {steps}  episodes {figures['episodes']}  goals {figures['goals']}  "
        f"collisions {figures['collisions']}  interventions {share(figures['interventions'], figures['steps'])}  "
        f"{sum(learner['steps_per_s'] for learner in learners):.0f} steps/s  {updates:.0f} updates/s"
    )


def live(view: RunView, figures: dict[str, Any], bar: Progress) -> RenderableType:
    """Format progress, learning, safety, processes and the latest warnings."""
    parts: list[RenderableType] = [Text(run_phase(view), "bold"), bar, _run(figures), _processes(view)]
    if view.lines:
        parts += [Text(text, "yellow", no_wrap=True, overflow="ellipsis") for text in list(view.lines)[-LINES:]]
    subtitle = "ending" if view.ending else "^C ends every process in order"
    return Panel(Group(*parts), title=Text(f"brakeline: {view.folder}"), subtitle=subtitle)


def _run(figures: dict[str, Any]) -> Table:
    """Format the figures in two columns of names and values, for 80 columns."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    episodes, steps = figures["episodes"], figures["steps"]
    times, trip, contained = figures["decision_ms"], figures["round_trip_ms"], figures["containment"]
    color = "green" if figures["collisions"] == 0 else "bold red"
    table.add_row("episodes", str(episodes), "goals", share(figures["goals"], episodes))
    table.add_row("collisions", f"[{color}]{figures['collisions']}[/]", "mean reward", _mean(figures))
    table.add_row("interventions", share(figures["interventions"], steps), "failsafe", str(figures["failsafes"]))
    clearance = "-" if figures["for_clearance"] is None else str(figures["for_clearance"])
    table.add_row("adjusted", share(figures["adjusted"], steps), "for clearance", clearance)
    table.add_row(
        "outside the set", share(contained["violations"], contained["steps"]), "no answer", str(figures["fallbacks"])
    )
    plans = figures["plans"]
    if plans["flown"]:
        left = f"{share(plans['outside'], plans['flown'])}; {stated(plans)}"
        table.add_row("plans outside tube", left)
    table.add_row("decide p50 / p99", _pair(times), "reply p50 / p99", _pair(trip))
    several = len(figures["learners"]) > 1
    for robot, learner in figures["learners"].items():
        steps_per_s, updates_per_s = (f"{learner[name]:.0f}/s" for name in ("steps_per_s", "updates_per_s"))
        table.add_row(f"steps {robot}" if several else "steps", steps_per_s, "updates", updates_per_s)
        critic, actor = (f"{learner[name]:.3f}" for name in ("critic_loss", "actor_loss"))
        table.add_row("critic loss", critic, "actor loss", actor)
        table.add_row("steps lost", str(learner["missing"]), "duplicate steps", str(learner["duplicates"]))
    return table


def _mean(figures: dict[str, Any]) -> str:
    return "-" if figures["mean_reward"] is None else f"{figures['mean_reward']:.1f}"


def _pair(times: dict[str, Any] | None) -> str:
    return "-" if times is None else f"{times['p50']:.2f} / {times['p99']:.2f} ms"


def _processes(view: RunView) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    for column in ("process", "state", "restarts"):
        table.add_column(column, style="dim" if column != "process" else "")
    for child in view.processes:
        state = "[green]runs[/]" if child.alive else "done" if child.finished else "[red]down[/]"
        if child.spec.name not in view.metrics.processes and not child.restarts and not child.finished:
            state = "[yellow]starts[/]"
        table.add_row(child.spec.name, state, str(child.restarts))
    return table


def share(count: int, of: int) -> str:
    """Format a count and its share."""
    return f"{count} ({count / of:.1%})" if of else str(count)


def summary(console: Console, figures: dict[str, Any]) -> None:
    """Print the figures of a run and the paths of its files."""
    console.print(show({name: value for name, value in figures.items() if name != "topics"}))
    lost = sum(topic["missing"] for topic in figures["topics"].values())
    restarts = ", ".join(f"{name} {count}" for name, count in figures["restarts"].items())
    console.print(f"messages lost: {lost}; restarts: {restarts or 'none'}")
    if "from_logs" in figures:
        fed = figures["from_logs"]
        console.print(
            f"steps from logs: {fed.get('published', 0)}, and {fed.get('known', 0)} that the learner had already"
        )
    if not figures["finished"] and figures.get("policy") in (None, "learning"):
        console.print(
            f"[yellow]stopped before the last step[/]; continue with: brakeline train --resume {figures['folder']}"
        )
    console.print(f"log:    {figures['log'] or 'not recorded'}", markup=False)
    for path in figures["policies"]:
        console.print(f"policy: {path}", markup=False)
    for command in following(figures):
        console.print(f"next:   {command}", markup=False)


def following(figures: dict[str, Any]) -> list[str]:
    """Return useful commands after a run."""
    commands = []
    if figures["log"]:
        commands += [
            f"brakeline analyse {figures['folder']} --html report.html",
            f"brakeline replay {figures['folder']}",
        ]
    robots = list(figures["robots"])
    if figures["policies"] and len(robots) == 1:
        commands.append(f"brakeline evaluate {robots[0]} --policy {figures['policies'][0]}")
    return commands
