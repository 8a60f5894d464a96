"""The paper's Table I from the results of a comparison, with intervals and the paper's own numbers.

These are pure functions from the JSON results to values and Markdown. Rows whose names end in "[ms]" are measured
times; all others are determined by the seeds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.experiments.bootstrap import MeanEstimate, mean, rate, ratio, share
from brakeline.deploy.experiments.compared_methods import NONE, compared, in_order
from brakeline.deploy.experiments.comparison_cells import TrialConfig
from brakeline.deploy.experiments.episode_table import CONTACTS
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED
from brakeline.messaging.robot import Array
from brakeline.safety.model.model_config import DDPC

Result = dict[str, Any]
Row = dict[str, Any]

PAPER = Path(__file__).with_name("paper.json")
WINDOW = 50  # training episodes per goal rate
LEARNED = 0.9  # the goal rate that counts as learned
ENDS = ("goal", "collision", "timeout", *CONTACTS)  # of an episode; another one was cut
THIRDS = tuple(f"goal rate, {third} third" for third in ("first", "second", "last"))  # of a training
CUT = "episodes cut by interventions"
TOUCHED = ("run into while moving", "run into while standing")  # the table's names of CONTACTS


def spans(episodes: dict[str, list[float]]) -> tuple[Array, Array]:
    """Return the training steps before and after each episode. In older results, one robot trained alone."""
    ends = np.array(episodes.get("end", np.cumsum(episodes["steps"])), float)
    return np.array(episodes.get("begin", ends - episodes["steps"]), float), ends


def was_cut(episodes: dict[str, list[float]]) -> NDArray[np.bool_]:
    """Return which training episodes an intervention of the method ended, as those of SAILR do.

    Where the results do not say which episodes ran out of time, none.
    """
    if "timeout" not in episodes:
        return np.zeros(len(episodes["goal"]), dtype=bool)
    ends = [np.array(episodes[name], bool) for name in ENDS if name in episodes]
    return np.asarray(~np.logical_or.reduce(ends), dtype=bool)


def without_cuts(episodes: dict[str, list[float]]) -> dict[str, list[float]]:
    """Return the training episodes that no intervention ended.

    A cut episode says nothing about the goal: most episodes with an intervention reach it in an evaluation, where the
    episode goes on. The other methods have none. Without them, the rest looks easier than it was, in favor of SAILR.
    """
    uncut = np.flatnonzero(~was_cut(episodes))
    return {name: [values[i] for i in uncut] for name, values in episodes.items()}


def steps_to_learn(episodes: dict[str, list[float]], steps: int) -> float:
    """Return the training steps until a share `LEARNED` of `WINDOW` episodes had reached the goal; `steps` if never.

    The episodes of a window began one after the other. So a batch, where short episodes end first, gains nothing.
    Episodes that an intervention cut do not count.
    """
    begin, end = spans(episodes)
    episodes = without_cuts(episodes | {"begin": begin.tolist(), "end": end.tolist()})
    if len(episodes["goal"]) < WINDOW:
        return float(steps)
    reached = np.where(np.array(episodes["goal"], bool), spans(episodes)[1], np.inf)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(reached, WINDOW), axis=1)
    return float(min(windows[:, math.ceil(LEARNED * WINDOW) - 1].min(), steps))


def evaluation_name(method: str, arena: str) -> str:
    """Return the name of the evaluation of a method's policies behind its own filter."""
    return TrialConfig(TRAINED, compared(method).filter, arena, 0).name


def evaluation_rows(results: Sequence[Result], trial: str) -> Row:
    """Return the figures of one evaluation over the seeds: estimates, or numbers where an interval has no meaning."""
    evaluations = [result["evaluations"][trial] for result in results]
    values, times = _by_column(evaluations), [evaluation["decision_ms"] for evaluation in evaluations]
    contacts = zip(TOUCHED, CONTACTS, strict=True) if values.keys() >= set(CONTACTS) else ()  # old results lack them
    return {
        "goal rate": rate(values["goal"], crossed=True),
        "collision rate": rate(values["collision"], crossed=True),
        **{row: rate(values[name], crossed=True) for row, name in contacts},
        "mean speed [m/s]": ratio(values["speed"], values["steps"], crossed=True),
        "max speed [m/s]": max(map(max, values["fastest"])),
        "mean reward": mean(values["reward"], crossed=True),
        "interventions": _interventions(values, trial.split("-")[1], crossed=True),
        "decision [ms]": float(np.mean([t["mean"] for t in times])),
        "its std [ms]": float(np.mean([t["std"] for t in times])),
    }


def training_rows(results: Sequence[Result]) -> Row:
    """Return the figures of training over the seeds. A rate is None if no episode of a training ended."""
    trainings, model = [result["training"] for result in results], results[0]["model"]
    values, steps = _by_column(trainings), [training["steps"] for training in trainings]
    learned = [steps_to_learn(training["episodes"], training["steps"]) for training in trainings]
    ended = all(map(len, values["collision"]))
    return {
        "collision rate": rate(values["collision"]) if ended else None,
        "collisions": float(np.mean([sum(counts) for counts in values["collision"]])),
        "steps to 90 % goals": mean([[value] for value in learned]),
        "seeds that got there": sum(value < limit for value, limit in zip(learned, steps, strict=True)),
        "interventions": _interventions(values, compared(results[0]["study"]["method"]).filter) if ended else None,
        CUT: rate([was_cut(training["episodes"]) for training in trainings]) if ended else None,
        "pre-training samples": 0 if model is None else int(model["samples"]),
        "pre-training collisions": 0 if model is None else int(model["collisions"]),
        **_goals_by_third(trainings),
    }


def _interventions(values: dict[str, list[list[float]]], method: str, *, crossed: bool = False) -> MeanEstimate:
    """Return the share of steps with an intervention of a method that filters. Of the method `none`, 0 is certain."""
    estimate = ratio if method == NONE else share
    return estimate(values["interventions"], values["steps"], crossed=crossed)


def _goals_by_third(trainings: Sequence[Result]) -> Row:
    """Return the goal rates of the episodes that ended in each third of the steps, which show where learning ends.

    Episodes that an intervention cut do not count. A rate is None if a training has no other that ended in this third.
    """
    goals: dict[str, list[Array]] = {row: [] for row in THIRDS}
    for training in trainings:
        third = np.ceil(3.0 * spans(training["episodes"])[1] / training["steps"])
        whole = ~was_cut(training["episodes"])
        for number, row in enumerate(THIRDS, start=1):
            goals[row].append(np.array(training["episodes"]["goal"])[whole & (np.minimum(third, 3.0) == number)])
    return {row: rate(seeds) if all(map(len, seeds)) else None for row, seeds in goals.items()}


def _by_column(trials: Sequence[Result]) -> dict[str, list[list[float]]]:
    """Return the values of each column that all trials have: one list of episodes for each trial."""
    names = set.intersection(*(set(trial["episodes"]) for trial in trials))
    return {name: [trial["episodes"][name] for trial in trials] for name in names}


def table(results: Iterable[Result]) -> dict[str, Any]:
    """Return all figures of one robot, by part (training, arenas, deployment), method and row.

    Raises:
        ValueError: the results belong to several robots.
    """
    cells = sorted(results, key=lambda cell: int(cell["study"]["seed"]))
    order = in_order(cell["study"]["method"] for cell in cells)
    groups = {m: [cell for cell in cells if cell["study"]["method"] == m] for m in order}
    seeds = {m: [c["study"]["seed"] for c in group] for m, group in groups.items()}
    robots = {c["study"]["robot"] for c in cells}
    if len(robots) != 1:
        raise ValueError(f"not the results of one robot: {robots}")
    study = cells[0]["study"]
    parts: dict[str, dict[str, Row]] = {"training": {m: training_rows(group) for m, group in groups.items()}}
    for arena in study["arenas"]:
        parts[arena] = {m: evaluation_rows(g, evaluation_name(m, arena)) for m, g in groups.items()}
    parts["deployment"] = _deployment(groups, study["arenas"][0])
    about = {"robot": study["robot"], "seeds": seeds, "versions": cells_by_version(cells)}
    return about | {"steps": study["steps"], "episodes": study["episodes"], "parts": parts}


def cells_by_version(cells: Iterable[Result]) -> dict[str, list[str]]:
    """Return the names of the cells by the versions of Brakeline and of the packages that made them."""
    names: dict[str, list[str]] = {}
    for cell in cells:
        versions = ", ".join(f"{package} {number}" for package, number in cell.get("versions", {}).items())
        names.setdefault(versions or "not stated", []).append(f"{cell['study']['method']}-s{cell['study']['seed']}")
    return names


def version_note(versions: dict[str, list[str]]) -> str:
    """Return which version made which cells, or an empty text if one made all."""
    if len(versions) < 2:
        return ""
    made = [f"{version} ({', '.join(names)})" for version, names in versions.items()]
    return f"{len(versions)} versions made the cells: {'; '.join(made)}"


DEPLOYMENT = (  # name, method of the training, policy and filter of the evaluation
    ("trained without, run with the filter", NONE, f"{TRAINED}-{DDPC}"),
    ("trained with, run without the filter", DDPC, f"{TRAINED}-{NONE}"),
    ("untrained, run with the filter", DDPC, f"{UNTRAINED}-{DDPC}"),
)


def _deployment(groups: dict[str, list[Result]], arena: str) -> dict[str, Row]:
    """Return the rows for a filter that is added or removed after training, and for an untrained policy."""
    return {
        name: evaluation_rows(groups[method], f"{trial}-{arena}")
        for name, method, trial in DEPLOYMENT
        if method in groups
    }


def plain(value: Any) -> Any:
    """Convert estimates to JSON values."""
    if isinstance(value, MeanEstimate):
        return {"value": value.value, "low": value.low, "high": value.high, "seeds": list(value.seeds)}
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    return value


PERCENT = ("goal rate", "collision rate", "interventions", CUT, *TOUCHED, *THIRDS)
RARE = ("collision rate", *TOUCHED)  # shares near 0: with one decimal, an upper end of 0.15 % would read 0.1 %
OF_SEEDS = ("steps to 90 % goals",)  # one number for each seed, not for each episode
DIGITS = {
    "collisions": ".1f",
    "mean speed [m/s]": ".3g",
    "max speed [m/s]": ".3g",
    "decision [ms]": ".2f",
    "its std [ms]": ".2f",
}


def written(name: str, value: Any) -> str:
    """Format a figure for the table, with its interval in brackets."""
    if value is None:
        return "–"
    factor, unit = (100.0, " %") if name in PERCENT else (1.0, "")
    digits = ".2f" if name in RARE else ".1f" if name in PERCENT else DIGITS.get(name, ".0f")
    if isinstance(value, MeanEstimate) and name in OF_SEEDS and value.low == value.high:
        value = value.value  # one seed has no interval, and where no seed got there, each counts alike
    if isinstance(value, MeanEstimate):
        middle, low, high = (f"{factor * v:{digits}}" for v in (value.value, value.low, value.high))
        return f"{middle}{unit} [{low}, {high}]"
    return f"{factor * float(value):{digits}}{unit}"


PAPER_ROWS: dict[str, Callable[[dict[str, Any], str], str]] = {
    "goal rate": lambda paper, row: f"{paper['goal']:g} %",
    "collision rate": lambda paper, row: f"{paper['collision']:g} %",
    "mean speed [m/s]": lambda paper, row: written(row, paper["mean_speed"]),
    "max speed [m/s]": lambda paper, row: written(row, paper["max_speed"]),
    "mean reward": lambda paper, row: written(row, paper["reward"]),
    "decision [ms]": lambda paper, row: f"{paper['decision_ms'][0]:.1f}",
    "its std [ms]": lambda paper, row: f"{paper['decision_ms'][1]:.1f}",
}


def _paper(robot: str, row: str, method: str) -> str:
    """Return the paper's figure for a row, or an empty string."""
    published = json.loads(PAPER.read_text()).get(robot, {}).get(method)
    return "" if published is None or row not in PAPER_ROWS else PAPER_ROWS[row](published, row)


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = ["|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|" for cells in (heads, *rows)]
    return [lines[0], "|---" * len(heads) + "|", *lines[1:]]


def markdown(figures: dict[str, Any], quick: bool = False) -> str:
    """Return the tables of one robot as Markdown, with the paper's figures in italics.

    quick: the runs are too short to say anything about the methods.
    """
    robot, counts = figures["robot"], {method: len(seeds) for method, seeds in figures["seeds"].items()}
    lines = [
        f"# {robot}",
        "",
        *(["**A test of the code (`--quick`), no result**: few steps, small networks, one seed.", ""] if quick else []),
        f"Every method after {figures['steps']} training steps; {figures['episodes']} episodes for each of n seeds, "
        "the same for all methods and seeds. In brackets: 95 % intervals by the bootstrap, which resamples the seeds "
        "and, for all seeds alike, the episodes; where nothing or all happened, the exact one of Clopper and Pearson, "
        "which takes the episodes of all seeds as independent. In italics: the paper's "
        "figures, for its own task. Decision times are of policy and method together.",
        "",
        "Before training, the methods knew the robot from the recorded periods in the row *pre-training samples*. If "
        f"a seed did not reach 90 % of goals, {figures['steps']} counts as its steps to 90 %. Ours gets obstacles from "
        "the arena's map, as do CBF-QP and PSF. SAILR and SECAS decide by the rays that the policy observes. A goal "
        "rate of a third is of the episodes that ended in this third of the training steps. Episodes that an "
        "intervention cut (SAILR) do not count for the steps to 90 % and for the goals of a third.",
        "",
    ]
    if any(None in row.values() for row in figures["parts"]["training"].values()):
        lines += ["–: in the training of some seed, no episode ended (in this third). Train for more steps.", ""]
    if note := version_note(figures["versions"]):
        lines += [f"**{note}.**", ""]
    for part, methods in figures["parts"].items():
        rows = []
        for row in next(iter(methods.values()), {}):
            rows.append([row, *(written(row, values[row]) for values in methods.values())])
            beside = [_paper(robot, row, method) for method in methods]
            if part not in ("training", "deployment") and any(beside) and not quick:
                rows.append(["*paper*", *(f"*{text}*" if text else "" for text in beside)])
        heads = [f"{compared(m).label}, n = {counts[m]}" if m in counts else m for m in methods]
        lines += [f"## {part}", "", *markdown_table(["", *heads], rows), ""]
    return "\n".join(lines)
