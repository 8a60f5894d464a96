"""Show a run on the console: a live table during the run and a summary at its end."""

from __future__ import annotations

import time
from shlex import quote
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from brakeline.deploy import progress
from brakeline.deploy.run.launcher import Launcher
from brakeline.deploy.run.live_page import LivePage
from brakeline.deploy.run.verdict import verdict
from brakeline.logs.figure_tables import known, share, show
from brakeline.logs.stacking_table import PLAIN
from brakeline.logs.tube_stats import stated

REFRESH = 1.0  # s between updates of the table: one takes 20 to 50 ms of processor time
SPACING = 10.0  # s between lines without a terminal
LINES = 5  # shown warnings


class Display:
    """Shows a run. You can call it at any rate: it limits the redrawing itself."""

    def __init__(self, console: Console, steps: int, page: LivePage | None = None) -> None:
        """steps: of all robot kinds. page: the run's live page, whose address it shows."""
        self.console, self._page = progress.console if progress.console.quiet else console, page
        self._bar = Progress(
            TextColumn("steps"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        )
        self._task = self._bar.add_task("steps", total=steps)
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._last = -1e9 if self._live is not None else time.monotonic()
        self._last_phase = ""  # the last printed phase, without a terminal
        self._page_shown = False

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, run: Launcher) -> None:
        """Show the run as it is now."""
        if self._live is None and (phase := run_phase(run)) != self._last_phase:
            self._last_phase = phase
            self.console.print(phase, markup=False)
            self._print_warnings(run)
        if self._page is not None and self._page.notice and not self._page_shown:
            self._page_shown = True
            self.console.print(self._page.notice, markup=False)
        spacing = REFRESH if self._live is not None else SPACING
        if time.monotonic() - self._last < spacing and not (run.ending and self._live is not None):
            return
        self._last = time.monotonic()
        figures = run.metrics.figures()
        learned = sum(learner["steps"] for learner in figures["learners"].values())
        self._bar.update(self._task, completed=max(figures["steps"], learned))  # a resumed run has earlier steps
        if self._live is not None:
            self._live.update(live(run, figures, self._bar), refresh=True)
        else:
            self.console.print(line(figures))
            self._print_warnings(run)

    def _print_warnings(self, run: Launcher) -> None:
        """Print the latest warnings, each once: without a terminal, nothing else shows that a process hangs."""
        waiting = list(run.lines)
        run.lines.clear()
        for text in waiting[-LINES:]:
            self.console.print(text, markup=False)
        if len(waiting) > LINES:
            self.console.print(f"({len(waiting) - LINES} earlier warnings are in the log)", markup=False)


def run_phase(run: Launcher) -> str:
    """Return what the run is doing now."""
    if run.ending:
        return "ending every process in order"
    heard = run.metrics.processes.copy()
    starting = [child.spec.name for child in run.processes if child.spec.name not in heard and not child.finished]
    if starting:
        return f"starting {', '.join(starting)}"
    if not any(stats.steps for stats in run.metrics.actors.copy().values()) and run.config.actors:
        return "waiting for the first step"
    return "driving" if run.config.policy else "driving and learning" if run.config.actors else "learning from logs"


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


def live(run: Launcher, figures: dict[str, Any], bar: Progress) -> RenderableType:
    """Format progress, learning, safety, processes and the latest warnings."""
    parts: list[RenderableType] = [Text(run_phase(run), "bold"), bar, _figures_table(figures), _processes(run)]
    if run.lines:
        parts += [Text(text, "yellow", no_wrap=True, overflow="ellipsis") for text in list(run.lines)[-LINES:]]
    subtitle = "ending" if run.ending else "^C ends every process in order"
    return Panel(Group(*parts), title=Text(f"brakeline: {run.folder}"), subtitle=subtitle)


def _figures_table(figures: dict[str, Any]) -> Table:
    """Format the figures in two columns of names and values, for 80 columns."""
    episodes, steps, plans = figures["episodes"], figures["steps"], figures["plans"]
    contained, color = figures["containment"], "bold red" if figures["collisions"] else "green"
    reward = known("{:.1f}", figures["mean_reward"], "-")
    rows = [
        ("episodes", str(episodes), "goals", share(figures["goals"], episodes)),
        ("collisions", f"[{color}]{figures['collisions']}[/]", "mean reward", reward),
        ("interventions", share(figures["interventions"], steps), "failsafe", str(figures["failsafes"])),
        ("adjusted", share(figures["adjusted"], steps), "for clearance", known("{}", figures["for_clearance"], "-")),
        ("outside the set", share(contained["violations"], contained["steps"]), "no answer", str(figures["fallbacks"])),
    ]
    if plans["flown"]:
        rows.append(("plans outside tube", f"{share(plans['outside'], plans['flown'])}; {stated(plans)}", "", ""))
    if plans["scored"] or plans["widening"] > 1.0:
        widest, windows = f"{plans['widening']:.3g} times", share(plans["beyond"], plans["scored"])
        rows.append(("windows outside sets", windows if plans["scored"] else "-", "widened by up to", widest))
    if plans["slowed"]:
        rows.append(("slowed down", share(plans["slowed"], steps), "began", f"{plans['slow_downs']} times"))
    notes = {name: note for process in figures["processes"].values() for name, note in process["notes"].items()}
    rows += [("new model set", escape(notes[name]), "", "") for name in sorted(notes) if name.startswith("adaptation ")]
    decide, reply = (
        known("{0[p50]:.2f} / {0[p99]:.2f} ms", figures[name], "-") for name in ("decision_ms", "round_trip_ms")
    )
    rows.append(("decide p50 / p99", decide, "reply p50 / p99", reply))
    for robot, learner in figures["learners"].items():
        name = f"steps {robot}" if len(figures["learners"]) > 1 else "steps"
        rows += [
            (name, f"{learner['steps_per_s']:.0f}/s", "updates", f"{learner['updates_per_s']:.0f}/s"),
            ("critic loss", f"{learner['critic_loss']:.3f}", "actor loss", f"{learner['actor_loss']:.3f}"),
            ("steps lost", str(learner["missing"]), "duplicate steps", str(learner["duplicates"])),
        ]
    table = Table(show_header=False, **PLAIN)
    for row in rows:
        table.add_row(*row)
    return table


def _processes(run: Launcher) -> Table:
    table = Table(**PLAIN)
    for column in ("process", "state", "restarts"):
        table.add_column(column, style="dim" if column != "process" else "")
    for child in run.processes:
        state = "[green]runs[/]" if child.alive else "done" if child.finished else "[red]down[/]"
        if child.spec.name not in run.metrics.processes and not child.restarts and not child.finished:
            state = "[yellow]starts[/]"
        table.add_row(child.spec.name, state, str(child.restarts))
    return table


def summary(console: Console, figures: dict[str, Any], verbose: bool = False) -> None:
    """Print the verdict on a run and what its log lacks; with `verbose` all figures and the paths of its files too."""
    if verbose:
        _print_everything(console, figures)
    first, *others = verdict(figures)
    console.print(first, style="bold red" if figures["collisions"] else "bold", markup=False)
    for line in others:
        console.print(line, markup=False)
    log = figures.get("log_messages")
    if log is not None and not verbose and (log["missing"] or log["failures"]):
        console.print(log_line(log))


def _print_everything(console: Console, figures: dict[str, Any]) -> None:
    console.print(show({name: value for name, value in figures.items() if name not in ("topics", "latest")}))
    lost = sum(topic["missing"] for topic in figures["topics"].values())
    restarts = ", ".join(f"{name} {count}" for name, count in figures["restarts"].items())
    console.print(f"messages lost on the way to the display: {lost}; restarts: {restarts or 'none'}")
    if (log := figures.get("log_messages")) is not None:
        console.print(log_line(log))
    lines = [f"log:    {figures['log'] or 'not recorded'}", *(f"policy: {path}" for path in figures["policies"])]
    for line in (*lines, *(f"next:   {command}" for command in following(figures))):
        console.print(line, markup=False)


def log_line(log: dict[str, Any]) -> str:
    """Say how many messages the log has, how many it lacks, and why."""
    if not log["missing"] and not log["failures"]:
        return f"messages in the log: {log['recorded']}, all that were published"
    why = f" ({escape('; '.join(log['failures']))})" if log["failures"] else ""
    return f"messages in the log: {log['recorded']}; [red]NOT in the log: {log['missing']}[/]{why}"


def following(figures: dict[str, Any]) -> list[str]:
    """Return useful commands after a run, besides that of the verdict."""
    folder, robots, commands = figures["folder"], list(figures["robots"]), []
    if figures["log"]:
        commands.append(f"brakeline replay {quote(folder)}")
    if figures["policies"] and len(robots) == 1:
        commands.append(f"brakeline evaluate {robots[0]} --policy {quote(figures['policies'][0])}")
    return commands
