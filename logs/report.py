"""Print the figures of a log as tables."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from brakeline.logs.console_tables import PLAIN, StackingTable
from brakeline.logs.episode_stats import CONTACTS
from brakeline.logs.log_analysis import SETUP, analyse_runs
from brakeline.logs.metrics import Figures
from brakeline.logs.reader import Paths
from brakeline.logs.tube_stats import stated

BLOCKS = "▁▂▃▄▅▆▇█"


def analyse(paths: Paths) -> Figures:
    """Return the figures of the logs at `paths`: metrics, learning curves, configuration of each run, damage.

    A value of the configuration is None if the log does not have it or if the runs differ.

    Raises:
        LogError: a path has no log, or a file is not an MCAP file.
    """
    return analyse_runs(paths).figures()


def show(figures: Figures, verbose: bool = False) -> RenderableType:
    """Format figures of `analyse`, `Metrics` or `closed_loop` as tables for a rich console.

    Several runs are rows of one table; their figures are not pooled.

    Args:
        verbose: also show the metadata of the log.
    """
    several = len(figures.get("runs", {})) > 1
    parts: list[RenderableType] = [_runs(figures["runs"]) if several else _summary(figures)]
    if not several:
        parts += _times(figures)
    parts += [_training(robot, training) for robot, training in figures.get("training", {}).items()]
    if figures.get("processes") and figures.get("topics"):
        parts.append(_processes(figures["processes"]))
    if figures.get("topics"):
        parts.append(_topics(figures["topics"]))
    if verbose and figures.get("metadata"):
        parts.append(_metadata(figures["metadata"]))
    parts += [Text(cut, "yellow") for cut in figures.get("cuts", ())]
    return Group(*parts)


def _times(figures: Figures) -> list[RenderableType]:
    """Format decision times: by part if the log has the exchanges."""
    if any(part for parts in figures.get("latency_ms", {}).values() for part in parts.values()):
        return [_latency(figures["latency_ms"])]
    return [_decisions(figures["decision_ms"])] if figures.get("decision_ms") else []


def show_episode(episode: Figures) -> RenderableType:
    """Format one entry of `episode_detail`, step by step."""
    closest = _optional(", closest approach {:.3f} m", episode["closest"])
    title = (
        f"{episode['actor']}, episode {episode['episode']} ({episode['arena'] or 'arena not in the log'}): "
        f"{episode['outcome']} after {episode['steps']} steps, reward {episode['reward']:.2f}{closest}"
    )
    table = StackingTable(
        "step", "x, y [m]", "proposed", "executed", "decision", "ms", "margin [m]", "clear [m]", "why", **PLAIN
    )
    for row in episode["rows"]:
        table.add_row(
            str(row["step"]),
            _vector(row["state"][:2]),
            _vector(row["proposed"]),
            _vector(row["action"]),
            row["decision"] or "-",
            _optional("{:.2f}", row["decide_ms"]),
            _optional("> {:.4f}" if row["at_least"] else "{:.4f}", row["margin"]),
            f"{row['clearance']:.3f}",
            row["said"] or row["reason"] or "",
        )
    return Group(Text(title, "bold"), table)


def _vector(values: list[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _summary(figures: Figures) -> Table:
    table = StackingTable(show_header=False, **PLAIN)
    episodes, steps = figures["episodes"], figures["steps"]
    within = figures.get("intervals") or {}
    setup = [f"{name} {figures[name]}" for name in SETUP if figures.get(name) is not None]
    if setup:
        table.add_row("configuration", ", ".join(setup))
    table.add_row("steps", f"{steps}" + _optional(", {:.1f}/s", figures.get("steps_per_s")))
    table.add_row("episodes", f"{episodes}" + _optional(", mean reward {:.2f}", figures["mean_reward"]))
    touched = CONTACTS if figures["fleet"] else CONTACTS[:2]
    for name in ("goals", "collisions", *touched, "timeouts"):
        table.add_row(name.replace("_", " "), _share(figures[name], episodes, within.get(name)))
    interventions = _share(figures["interventions"], steps, within.get("interventions"))
    table.add_row("interventions", f"{interventions}, {figures['failsafes']} of them failsafe")
    table.add_row("adjusted", _share(figures["adjusted"], steps))
    table.add_row("adjusted for clearance", for_clearance(figures))
    table.add_row(
        "speed",
        _optional("{:.3f} m/s", figures["mean_speed"]) + _optional(", at most {:.3f} m/s", figures["max_speed"]),
    )
    table.add_row("closest approach", _optional("{:.3f} m, to fixed obstacles", figures.get("closest_approach")))
    containment = figures["containment"]
    outside = _share(containment["violations"], containment["steps"], within.get("violations"), digits=3)
    table.add_row("outside the predicted set", outside)
    if figures["recovering"]:
        table.add_row("recovering", _share(figures["recovering"], steps))
    if figures["broken"]:
        table.add_row("obstacles outside their bounds", str(figures["broken"]))
    table.add_row("outside the measurement bound", _share(figures["outside"], steps))
    _add_safety(table, figures)
    for robot, learner in figures.get("learners", {}).items():
        table.add_row(f"learner {robot}", LEARNER.format(**learner))
    return table


def for_clearance(figures: Figures) -> str:
    """Describe how many verified proposals the filter replaced to keep the clearance margin."""
    if figures["for_clearance"] is None:
        return "not recorded by this method or version"
    return f"{figures['for_clearance']} of {figures['adjusted']} adjusted proposals were verified themselves"


def _add_safety(table: Table, figures: Figures) -> None:
    """Add the rows that need the exchanges with the safety service."""
    if figures.get("round_trip_ms"):
        table.add_row("request to reply", "p50 {p50:.2f} ms, p99 {p99:.2f} ms".format(**figures["round_trip_ms"]))
    for reason, count in figures.get("no_decision", {}).items():
        table.add_row("no decision", f"{count}: {reason}")
    if figures.get("tube_half_width"):
        table.add_row("tube half-width", "p50 {p50:.4f} m, at most {max:.4f} m".format(**figures["tube_half_width"]))
    solver = figures.get("solver") or {}
    if solver.get("programs"):
        statuses = ", ".join(f"{status} {count}" for status, count in solver["statuses"].items())
        iterations = "iterations p50 {p50:.0f}, at most {max:.0f}".format(**solver["iterations"])
        table.add_row(
            "solver", f"{solver['programs']} programs, {solver['failures']} failed ({statuses}); {iterations}"
        )
    plans = figures.get("plans") or {}
    if plans.get("flown"):
        outside = f"{_share(plans['outside'], plans['flown'])}; {stated(plans)}"
        table.add_row("verified plans that were followed", f"{plans['flown']}, left their tube: {outside}")
    if figures.get("unverified"):
        table.add_row("[red]unverified failsafes[/]", str(figures["unverified"]))
    if figures.get("not_finite"):
        table.add_row("[red]proposals with NaN or infinity[/]", str(figures["not_finite"]))


LEARNER = (
    "{updates} updates, critic loss {critic_loss:.4g}, actor loss {actor_loss:.4g}, weights v{weights_version}, "
    "staleness {staleness:.1f}, steps missing {missing}, duplicate {duplicates}"
)


def _runs(runs: dict[str, Figures]) -> Table:
    """Format one row for each of several runs."""
    columns = (
        "method",
        "certificate",
        "perception",
        "seed",
        "steps",
        "episodes",
        "goals",
        "collisions",
        "interventions",
        "reward",
    )
    table = StackingTable("run", *columns, **PLAIN)
    for label, run in runs.items():
        setup = [
            "-" if run[name] is None else str(run[name]) for name in ("method", "certificate", "perception", "seed")
        ]
        episodes = run["episodes"]
        ends = [_share(run[name], episodes) for name in ("goals", "collisions")]
        stopped = _share(run["interventions"], run["steps"])
        reward = _optional("{:.1f}", run["mean_reward"])
        table.add_row(label, *setup, str(run["steps"]), str(episodes), *ends, stopped, reward)
    return table


def _decisions(times: Figures) -> Table:
    table = StackingTable("decision [ms]", "mean", "std", "p50", "p99", **PLAIN)
    for kind in ("all", "allowed", "adjusted", "failsafe", "recovering"):
        row = times if kind == "all" else times[kind]
        if row is not None:
            table.add_row(kind, *(f"{row[name]:.3f}" for name in ("mean", "std", "p50", "p99")))
    return table


def _latency(latency: Figures) -> Table:
    """Format the latency by kind of decision and part."""
    columns = ("mean", "std", "p50", "p90", "p99", "max")
    table = StackingTable("decision [ms]", "part", *columns, **PLAIN)
    for kind, parts in latency.items():
        for part, row in parts.items():
            if row is not None:
                first = f"{kind} ({row['count']})" if part == "round_trip" else ""
                table.add_row(first, part.replace("_", " "), *(f"{row[name]:.3f}" for name in columns))
    return table


def _training(robot: str, training: Figures) -> Table:
    """Format the learning curves as sparklines."""
    bins = _coarse(training["bins"], 60)
    table = StackingTable(f"{robot} over training", "first", "last", "", **PLAIN)
    for label, name in (("interventions", "interventions"), ("goals", "goals"), ("reward", "reward")):
        values = [row[name] for row in bins if row[name] is not None]
        if values:
            table.add_row(label, f"{values[0]:.3g}", f"{values[-1]:.3g}", _sparkline(values))
    stale = training["staleness"]
    if stale is not None and stale["max"] > 0:
        table.add_row(
            "weights behind", "", "", "mean {mean:.2f}, p99 {p99:.0f}, at most {max:.0f} versions".format(**stale)
        )
    return table


def _coarse(bins: list[Figures], most: int) -> list[Figures]:
    """Merge neighbouring bins to at most `most` bins."""
    per = -(-len(bins) // most) or 1
    rows = []
    for start in range(0, len(bins), per):
        part = bins[start : start + per]
        steps, episodes = sum(row["steps"] for row in part), sum(row["episodes"] for row in part)
        ended = [row for row in part if row["episodes"]]
        rows.append(
            {"interventions": sum((row["adjusted"] + row["failsafes"]) * row["steps"] for row in part) / steps}
            | {
                name: sum(row[name] * row["episodes"] for row in ended) / episodes if episodes else None
                for name in ("goals", "reward")
            }
        )
    return rows


def _sparkline(values: list[float]) -> str:
    low, high = min(values), max(values)
    scale = (len(BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(BLOCKS[round((value - low) * scale)] for value in values)


def _processes(processes: Figures) -> Table:
    table = StackingTable("process", "starts", "alive, s", "messages/s", "silences", "ended", **PLAIN)
    for name, process in processes.items():
        rate = _optional("{:.1f}", process["messages_per_s"])
        longest = process["longest_silence"]
        silences = f"{process['silences']}" + (f" (longest {longest:.1f} s)" if process["silences"] else "")
        ended = process["notes"].get("died of", process["ended"])
        table.add_row(name, str(process["starts"]), f"{process['seconds']:.1f}", rate, silences, ended)
    return table


def _topics(topics: dict[str, dict[str, int]]) -> Table:
    table = StackingTable("topic", "messages", "missing", "duplicates", **PLAIN)
    for key, counts in topics.items():
        table.add_row(key, *(str(counts[name]) for name in ("messages", "missing", "duplicates")))
    return table


def _metadata(metadata: Figures) -> Table:
    """Format the metadata, without the configuration, which is long: --json and --html have it."""
    table = StackingTable("metadata", "", **PLAIN)
    for name, values in metadata.items():
        if name != "configuration" and isinstance(values, dict):
            table.add_row(name, Text(", ".join(f"{key} {value}" for key, value in values.items())))
    return table


def _share(count: int, of: int, within: list[float] | None = None, digits: int = 1) -> str:
    text = f"{count}" + (f" ({count / of:.{digits}%})" if of else "")
    return text + (f", 95 %: {within[0]:.{digits}%} to {within[1]:.{digits}%}" if within is not None else "")


def _optional(form: str, value: Any) -> str:
    return "" if value is None else form.format(value)
