"""What a log says, as figures and as a table."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.metrics import Figures, Metrics
from logs.reader import Paths, open_log

SETUP = ("method", "certificate", "policy", "arena", "seed")


def analyse(paths: Paths) -> Figures:
    """The figures of the log at `paths`: those of `Metrics`, how the run was set up, and what of the log is damaged.

    `method certificate policy arena seed` come from the metadata record `run`, None where it does not tell.

    Raises:
        NoLog: there is none.
        NotALog: a file is something else.
    """
    log = open_log(paths)
    metrics = Metrics()
    for record in log:
        metrics.add(record.key, record.message)
    about = log.metadata.get("run", {})
    setup: Figures = {name: about.get(name) for name in SETUP}
    if setup["seed"] is not None and setup["seed"].lstrip("-").isdigit():
        setup["seed"] = int(setup["seed"])
    damage = {"cuts": [str(cut) for cut in log.cuts], "malformed": log.malformed}
    return setup | metrics.figures() | {"log": [str(path) for path in log.paths]} | damage


def show(figures: Figures) -> RenderableType:
    """The figures that `analyse`, `Metrics` or `closed_loop` gave, as tables for a rich console."""
    parts: list[RenderableType] = [_summary(figures)]
    if figures.get("decision_ms"):
        parts.append(_decisions(figures["decision_ms"]))
    if figures.get("topics"):
        parts.append(_topics(figures["topics"]))
    parts += [Text(cut, "yellow") for cut in figures.get("cuts", ())]
    return Group(*parts)


def _summary(figures: Figures) -> Table:
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    episodes, steps = figures["episodes"], figures["steps"]
    setup = [f"{name} {figures[name]}" for name in SETUP if figures.get(name) is not None]
    if setup:
        table.add_row("set-up", ", ".join(setup))
    table.add_row("steps", f"{steps}" + _optional(", {:.1f}/s", figures.get("steps_per_s")))
    table.add_row("episodes", f"{episodes}" + _optional(", mean reward {:.2f}", figures["mean_reward"]))
    for name in ("goals", "collisions", "timeouts"):
        table.add_row(name, _share(figures[name], episodes))
    table.add_row(
        "interventions", _share(figures["interventions"], steps) + f", of these failsafe {figures['failsafes']}"
    )
    table.add_row(
        "speed", _optional("{:.3f} m/s", figures["mean_speed"]) + _optional(", at most {:.3f}", figures["max_speed"])
    )
    containment = figures["containment"]
    table.add_row("outside the predicted set", _share(containment["violations"], containment["steps"]))
    table.add_row("outside the measurement's bound", _share(figures["outside"], steps))
    if figures.get("round_trip_ms"):
        table.add_row("question to answer", "p50 {p50:.2f} ms, p99 {p99:.2f} ms".format(**figures["round_trip_ms"]))
    for reason, count in figures.get("no_decision", {}).items():
        table.add_row("no decision", f"{count}: {reason}")
    for robot, learner in figures.get("learners", {}).items():
        table.add_row(f"learner {robot}", LEARNER.format(**learner))
    return table


LEARNER = (
    "{updates} updates, critic loss {critic_loss:.4g}, actor loss {actor_loss:.4g}, "
    "weights v{weights_version}, staleness {staleness:.1f}"
)


def _decisions(times: Figures) -> Table:
    table = Table("decision [ms]", "mean", "std", "p50", "p99", box=None, padding=(0, 2, 0, 0))
    for kind in ("all", "allowed", "adjusted", "failsafe"):
        row = times if kind == "all" else times[kind]
        if row is not None:
            table.add_row(kind, *(f"{row[name]:.3f}" for name in ("mean", "std", "p50", "p99")))
    return table


def _topics(topics: dict[str, dict[str, int]]) -> Table:
    table = Table("topic", "messages", "missing", "duplicates", box=None, padding=(0, 2, 0, 0))
    for key, counts in topics.items():
        table.add_row(key, *(str(counts[name]) for name in ("messages", "missing", "duplicates")))
    return table


def _share(count: int, of: int) -> str:
    return f"{count}" + (f" ({count / of:.1%})" if of else "")


def _optional(form: str, value: Any) -> str:
    return "" if value is None else form.format(value)
