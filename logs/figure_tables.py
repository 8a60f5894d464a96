"""Print the figures of a log as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from brakeline.logs.episode_stats import CONTACTS, KINDS, RUN_INTO, Figures
from brakeline.logs.learning_curve import interventions_in
from brakeline.logs.log_analysis import SETUP, analyse_runs
from brakeline.logs.reader import Paths
from brakeline.logs.stacking_table import plain_table
from brakeline.logs.tube_stats import stated
from brakeline.messaging.stated_share import percent

BLOCKS = "▁▂▃▄▅▆▇█"
# Rows of the table of learning curves, and the names of their values in a bin.
SETS = {"outside the sets": "beyond", "widening": "widening", "half-width [m]": "half_width", "slowed down": "slowed"}
NOT_STATED = "not recorded: the program did not call `record_outcome`, nor `reset` with an outcome"
LEARNER = (
    "{updates} updates, critic loss {critic_loss:.4g}, actor loss {actor_loss:.4g}, weights v{weights_version}, "
    "staleness {staleness:.1f}, steps missing {missing}, duplicate {duplicates}"
)


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
    parts = _several(figures) if several else [plain_table((), _summary(figures)), *_times(figures)]
    parts += [_driving(robot, kinds) for robot, kinds in figures.get("driving", {}).items()]
    parts += [_training(robot, training) for robot, training in figures.get("training", {}).items()]
    if figures.get("processes") and figures.get("topics"):
        parts.append(_processes(figures["processes"]))
    if figures.get("topics"):
        counts = ("messages", "missing", "duplicates")
        rows = [(key, *(str(topic[name]) for name in counts)) for key, topic in figures["topics"].items()]
        parts.append(plain_table(("topic", *counts), rows))
    if verbose and (metadata := figures.get("metadata")):
        # The configuration is long, so only --json and --html show it.
        groups = {name: v for name, v in metadata.items() if name != "configuration" and isinstance(v, dict)}
        rows = [(name, Text(", ".join(f"{k} {v}" for k, v in group.items()))) for name, group in groups.items()]
        parts.append(plain_table(("metadata", ""), rows))
    return Group(*parts, *(Text(cut, "yellow") for cut in figures.get("cuts", ())))


def _several(figures: Figures) -> list[RenderableType]:
    """Return the tables of several runs: of each run, of groups of seeds, and of settings that differ."""
    parts: list[RenderableType] = [_runs(figures["runs"])]
    if groups := figures.get("groups"):
        parts.append(_groups(groups))
    pairs = []
    for pair in figures.get("improvements", ()):
        interval = "" if pair["interval"] is None else " [{:.2f}, {:.2f}]".format(*pair["interval"])
        if pair["probability"] is not None:
            pairs.append((f"{pair['of']} over {pair['over']}", pair["robot"], f"{pair['probability']:.2f}{interval}"))
    if pairs:
        parts.append(plain_table(("a run scores better", "robot", "probability"), pairs))
    if differing := figures.get("differences"):
        labels = list(figures["runs"])
        settings = [(name, *(known("{}", row[label], "–") for label in labels)) for name, row in differing.items()]
        parts.append(plain_table(("setting", *labels), settings))
    return parts


def _groups(groups: list[Figures]) -> Table:
    """Format the scores of groups of runs. A group of one run has no interval."""
    scores = {"goals": 100.0, "collisions": 100.0, "interventions": 100.0, "reward": 1.0}
    rows = []
    for group in groups:
        cells = []
        for name, factor in scores.items():
            score, unit = group["scores"][name], " %" if factor > 1.0 else ""
            interval = score["iqm_interval"]
            within = "" if interval is None else " [" + ", ".join(f"{factor * v:.1f}" for v in interval) + "]"
            cells.append("–" if score["iqm"] is None else f"{factor * score['iqm']:.1f}{unit}{within}")
        steps = " ".join(f"{count:,}" for count in sorted(set(group["steps"])))
        rows.append((group["name"], group["robot"], str(len(group["runs"])), steps, *cells))
    table = plain_table(("group", "robot", "runs", "steps", *scores), rows)
    table.caption = "interquartile means over runs, of their last 100 episodes; 95 % bootstrap intervals over runs"
    return table


def show_episode(episode: Figures) -> RenderableType:
    """Format one entry of `episode_detail`, step by step."""
    closest = known(", closest approach {:.3f} m", episode["closest"])
    title = (
        f"{episode['actor']}, episode {episode['episode']} ({episode['arena'] or 'arena not in the log'}): "
        f"{episode['outcome']} after {episode['steps']} steps, reward {episode['reward']:.2f}{closest}"
    )
    dim = episode["dim"]  # of the position; 0 in joint space
    columns = (
        "step",
        f"{', '.join('xyz'[:dim])} [m]" if dim else "state",
        "proposed",
        "executed",
        "decision",
        "decide [ms]",
        "margin [m]",
        "clearance [m]",
        "why",
    )
    rows = [
        (
            str(row["step"]),
            *(" ".join(f"{value:.2f}" for value in row[name]) for name in ("state", "proposed", "action")),
            ", ".join(filter(None, (row["decision"] or "-", row["limited"]))),
            known("{:.2f}", row["decide_ms"]),
            known("> {:.4f}" if row["at_least"] else "{:.4f}", row["margin"]),
            f"{row['clearance']:.3f}",
            row["said"] or row["reason"] or "",
        )
        for row in (row | {"state": row["state"][: dim or None]} for row in episode["rows"])
    ]
    return Group(Text(title, "bold"), plain_table(columns, rows))


def _summary(figures: Figures) -> Iterator[tuple[str | Text, str]]:
    """Yield a name and a value of each figure of one run."""
    episodes, steps = figures["episodes"], figures["steps"]
    intervals = figures.get("intervals") or {}
    setup = [f"{name} {figures[name]}" for name in (*SETUP, "model") if figures.get(name) is not None]
    if setup:
        yield "configuration", ", ".join(setup)
    yield "steps", f"{steps}" + known(", {:.1f}/s", figures.get("steps_per_s"))
    if figures.get("refused"):
        yield Text("steps that do not count", "red"), f"{figures['refused']}: repeated, or not permitted by the learner"
    has_outcomes = figures.get("outcomes_stated", True)
    yield "episodes", f"{episodes}" + (known(", mean reward {:.2f}", figures["mean_reward"]) if has_outcomes else "")
    if not has_outcomes:
        yield "goals, collisions, rewards", NOT_STATED
    ends = ("goals", "collisions", *(CONTACTS if figures["fleet"] else CONTACTS[:2]), "timeouts")
    for name in ends if has_outcomes else ():
        interval = intervals.get(name)
        text = share(figures[name], episodes, interval)
        if name == RUN_INTO:  # an episode may have several, so the interval is that of their mean number
            text = f"{figures[name]}" + known(", 95 %: {0[0]:.2g} to {0[1]:.2g} in an episode", interval)
        yield name.replace("_", " "), text
    interventions = share(figures["interventions"], steps, intervals.get("interventions"))
    yield "interventions", f"{interventions}, {figures['failsafes']} of them failsafe"
    yield "adjusted", share(figures["adjusted"], steps)
    yield "adjusted for clearance", for_clearance(figures)
    mean, most = figures["mean_speed"], figures["max_speed"]
    yield "speed", known("{:.3f} m/s", mean) + known(", at most {:.3f} m/s", most)
    yield "closest approach", known("{:.3f} m, to fixed obstacles", figures.get("closest_approach"))
    containment = figures["containment"]
    outside = share(containment["violations"], containment["steps"], intervals.get("violations"), digits=3)
    yield "outside the predicted set", outside if containment["steps"] else "no step has a predicted set"
    if figures["recovering"]:
        yield "recovering", share(figures["recovering"], steps)
    if figures["broken"]:
        yield "obstacles outside their bounds", str(figures["broken"])
    beyond = ": larger errors than the description states, as in a collision" if figures["outside"] else ""
    yield "outside the measurement bound", share(figures["outside"], steps) + beyond
    yield from _waits(figures)
    yield from _safety_rows(figures)
    for robot, learner in figures.get("learners", {}).items():
        yield f"learner {robot}", LEARNER.format(**learner)


def _waits(figures: Figures) -> Iterator[tuple[str, str]]:
    """Yield how long robots stood without an answer since the last start of their process. Such periods are no steps.

    Older logs lack the time.
    """
    waiting = [p["figures"] for p in figures.get("processes", {}).values() if p["figures"].get("waits")]
    if waiting:
        queries, seconds = (sum(one.get(name, 0.0) for one in waiting) for name in ("waits", "waited_s"))
        yield "standing without an answer", (f"{seconds:.1f} s, " if seconds else "") + f"{queries:.0f} queries"


def for_clearance(figures: Figures) -> str:
    """Describe how many verified proposals the filter replaced to keep the clearance margin."""
    if figures["for_clearance"] is None:
        return "not recorded by this method or version"
    if not figures["adjusted"]:
        return "0"
    return f"{figures['for_clearance']} of {figures['adjusted']} adjusted steps: the filter verified the proposal too"


def _safety_rows(figures: Figures) -> Iterator[tuple[str | Text, str]]:
    """Yield the rows that need the exchanges with the safety service."""
    if figures.get("round_trip_ms"):
        yield "request to reply", "p50 {p50:.2f} ms, p99 {p99:.2f} ms".format(**figures["round_trip_ms"])
    for reason, count in figures.get("no_decision", {}).items():
        yield "no decision", f"{count}: {reason}"
    if figures.get("tube_half_width"):
        yield "tube half-width", "p50 {p50:.4f} m, at most {max:.4f} m".format(**figures["tube_half_width"])
    solver = figures.get("solver") or {}
    if solver.get("programs"):
        statuses = ", ".join(f"{status} {count}" for status, count in solver["statuses"].items())
        iterations = "iterations p50 {p50:.0f}, at most {max:.0f}".format(**solver["iterations"])
        yield "solver", f"{solver['programs']} programs, {solver['failures']} failed ({statuses}); {iterations}"
    plans = figures.get("plans") or {}
    if plans.get("flown"):
        outside = f"{share(plans['outside'], plans['flown'])}; {stated(plans)}"
        yield "verified plans that were followed", f"{plans['flown']}, left their tube: {outside}"
    if plans.get("scored"):
        counts = (plans[name] for name in ("beyond", "beyond_plan", "beyond_widened"))
        every, of_plans, wide = (share(count, plans["scored"]) for count in counts)
        widest = f"{wide} as widened, by up to {plans['widening']:.3g} times"
        yield "windows outside the stated sets", f"{every}; {of_plans} outside those of plans, {widest}"
    elif plans.get("widening", 1.0) > 1.0:
        yield "sets widened", f"by up to {plans['widening']:.3g} times"
    if plans.get("slowed"):
        yield "slowed down", f"{share(plans['slowed'], figures['steps'])} of the steps, {plans['slow_downs']} times"
    for name, label in (("unverified", "unverified failsafes"), ("not_finite", "proposals with NaN or infinity")):
        if figures.get(name):
            yield Text(label, "red"), str(figures[name])


def _runs(runs: dict[str, Figures]) -> Table:
    """Format one row for each of several runs."""
    setup, ends = ("method", "certificate", "perception", "seed"), ("goals", "collisions")
    rows = [
        (
            label,
            *(known("{}", run[name], "-") for name in setup),
            *(str(run[name]) for name in ("steps", "episodes")),
            *(share(run[name], run["episodes"]) if run["outcomes_stated"] else "not recorded" for name in ends),
            share(run["interventions"], run["steps"]),
            known("{:.1f}", run["mean_reward"]) if run["outcomes_stated"] else "not recorded",
        )
        for label, run in runs.items()
    ]
    return plain_table(("run", *setup, "steps", "episodes", *ends, "interventions", "reward"), rows)


def _times(figures: Figures) -> list[Table]:
    """Format decision times: by part if the log has the exchanges."""
    columns: Sequence[str] = ("mean", "std", "p50", "p90", "p99", "max")
    rows = [
        (
            f"{kind} ({row['count']})" if part == "round_trip" else "",
            part.replace("_", " "),
            *_milliseconds(row, columns),
        )
        for kind, times in figures.get("latency_ms", {}).items()
        for part, row in times.items()
        if row is not None
    ]
    if rows:
        return [plain_table(("decision [ms]", "part", *columns), rows)]
    if not (times := figures.get("decision_ms")):
        return []
    columns = ("mean", "std", "p50", "p99")
    kinds = {"all": times, **{kind: times[kind] for kind in KINDS.values()}}
    rows = [(kind, *_milliseconds(row, columns)) for kind, row in kinds.items() if row is not None]
    return [plain_table(("decision [ms]", *columns), rows)]


def _milliseconds(row: Figures, columns: Sequence[str]) -> list[str]:
    return [f"{row[name]:.3f}" for name in columns]


def _driving(robot: str, kinds: Figures) -> Table:
    """Format the shares outside the stated sets by kind of driving, beside the bounds that the model set states."""
    rows = []
    for kind, counts in kinds.items():
        outside, bound = share(counts["outside"], counts["windows"], digits=2), counts["bound"]
        rows.append((kind, str(counts["windows"]), outside, "–" if bound is None else f"≤ {percent(bound)}"))
    table = plain_table((f"{robot} driving", "windows", "outside the stated sets", "stated, of plans"), rows)
    table.caption = "a window is as long as a plan; windows overlap, and may be of several kinds"
    return table


def _training(robot: str, training: Figures) -> Table:
    """Format the learning curves as sparklines."""
    bins, rows = _coarse(training["bins"], 60), []
    for name in ("interventions", "goals", "reward", *SETS):
        values = [row[SETS.get(name, name)] for row in bins if row[SETS.get(name, name)] is not None]
        if values:
            rows.append((name, f"{values[0]:.3g}", f"{values[-1]:.3g}", _sparkline(values)))
    rows += [("new model set", "", "", f"{row['model']} from step {row['from']}") for row in training["models"][1:]]
    stale = training["staleness"]
    if stale is not None and stale["max"] > 0:
        versions = "mean {mean:.2f}, p99 {p99:.0f}, at most {max:.0f} versions".format(**stale)
        rows.append(("weights behind", "", "", versions))
    return plain_table((f"{robot} over the run", "first", "last", ""), rows)


def _coarse(bins: list[Figures], most: int) -> list[Figures]:
    """Merge neighbouring bins to at most `most` bins."""
    per = -(-len(bins) // most) or 1
    rows = []
    for start in range(0, len(bins), per):
        part = bins[start : start + per]
        interventions = sum(interventions_in(row) * row["steps"] for row in part) / sum(row["steps"] for row in part)
        means: Figures = {}
        for name in ("goals", "reward"):
            ended = [row for row in part if row[name] is not None]
            episodes = sum(row["episodes"] for row in ended)
            means[name] = sum(row[name] * row["episodes"] for row in ended) / episodes if ended else None
        sets = {name: max((row[name] for row in part if row[name] is not None), default=None) for name in SETS.values()}
        rows.append({"interventions": interventions, **means, **sets})
    return rows


def _sparkline(values: list[float]) -> str:
    low, high = min(values), max(values)
    scale = (len(BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(BLOCKS[round((value - low) * scale)] for value in values)


def _processes(processes: Figures) -> Table:
    rows = []
    for name, process in processes.items():
        longest = f" (longest {process['longest_silence']:.1f} s)" if process["silences"] else ""
        seconds, rate = f"{process['seconds']:.1f}", known("{:.1f}", process["messages_per_s"])
        ended = process["notes"].get("died of", process["ended"])
        rows.append((name, str(process["starts"]), seconds, rate, f"{process['silences']}{longest}", ended))
    return plain_table(("process", "starts", "alive, s", "messages/s", "silences", "ended"), rows)


def share(count: int, of: int, interval: list[float] | None = None, digits: int = 1) -> str:
    """Format a count with its share, and the interval of the share if it is known."""
    text = f"{count}" + (f" ({count / of:.{digits}%})" if of else "")
    return text + (f", 95 %: {interval[0]:.{digits}%} to {interval[1]:.{digits}%}" if interval is not None else "")


def known(form: str, value: Any, otherwise: str = "") -> str:
    """Format a value; `otherwise` stands for None."""
    return otherwise if value is None else form.format(value)
