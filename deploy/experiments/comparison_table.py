"""The paper's Table I from the results of a comparison, with intervals and the paper's own numbers.

These are pure functions from the JSON results to values and Markdown. Rows whose names end in "[ms]" are measured
times; all others are determined by the seeds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.experiments.bootstrap import MeanEstimate, mean, ratio
from brakeline.deploy.experiments.comparison_cells import METHODS, NONE
from brakeline.deploy.experiments.trials import CONTACTS
from brakeline.deploy.policy_loading import TRAINED, UNTRAINED
from brakeline.safety.methods import DDPC

Result = dict[str, Any]
Row = dict[str, Any]

NAMES = {DDPC: "ours", "sailr": "SAILR", "secas": "SECAS", NONE: "TD3"}
PAPER = Path(__file__).with_name("paper.json")
WINDOW = 50  # training episodes per goal rate
LEARNED = 0.9  # the goal rate that counts as learned
TOUCHED = ("run into while moving", "run into while standing")  # the table's names of CONTACTS


def steps_to_learn(episodes: dict[str, list[float]], steps: int) -> float:
    """Return the training steps until a share `LEARNED` of `WINDOW` episodes reached the goal; `steps` if never."""
    goals, taken = np.array(episodes["goal"], float), np.cumsum(episodes["steps"])
    if len(goals) < WINDOW:
        return float(steps)
    rate = np.convolve(goals, np.full(WINDOW, 1.0 / WINDOW), "valid")
    reached = np.flatnonzero(rate >= LEARNED - 1e-9)
    return float(taken[WINDOW - 1 + reached[0]]) if len(reached) else float(steps)


def _episodes(results: Sequence[Result], trial: str, name: str) -> list[list[float]]:
    return [result["evaluations"][trial]["episodes"][name] for result in results]


def _training(results: Sequence[Result], name: str) -> list[list[float]]:
    return [result["training"]["episodes"][name] for result in results]


def evaluation_rows(results: Sequence[Result], trial: str) -> Row:
    """Return the figures of one evaluation over the seeds: estimates, or numbers where an interval has no meaning."""
    steps = _episodes(results, trial, "steps")
    times = [result["evaluations"][trial]["decision_ms"] for result in results]
    return {
        "goal rate": mean(_episodes(results, trial, "goal")),
        "collision rate": mean(_episodes(results, trial, "collision")),
        **_contacts(results, trial),
        "mean speed [m/s]": ratio(_episodes(results, trial, "speed"), steps),
        "max speed [m/s]": max(max(values) for values in _episodes(results, trial, "fastest")),
        "mean reward": mean(_episodes(results, trial, "reward")),
        "interventions": ratio(_episodes(results, trial, "interventions"), steps),
        "decision [ms]": float(np.mean([t["mean"] for t in times])),
        "its std [ms]": float(np.mean([t["std"] for t in times])),
    }


def _contacts(results: Sequence[Result], trial: str) -> Row:
    """Return contacts with moving obstacles; old results do not contain them."""
    if any(name not in result["evaluations"][trial]["episodes"] for result in results for name in CONTACTS):
        return {}
    return dict(zip(TOUCHED, (mean(_episodes(results, trial, name)) for name in CONTACTS), strict=True))


def training_rows(results: Sequence[Result]) -> Row:
    """Return the figures of training over the seeds."""
    learned = [steps_to_learn(r["training"]["episodes"], r["training"]["steps"]) for r in results]
    return {
        "collision rate": mean(_training(results, "collision")),
        "collisions": float(np.mean([sum(values) for values in _training(results, "collision")])),
        "steps to 90 % goals": mean([[value] for value in learned]),
        "seeds that got there": sum(value < r["training"]["steps"] for value, r in zip(learned, results, strict=True)),
        "interventions": ratio(_training(results, "interventions"), _training(results, "steps")),
        "pre-training samples": 0 if results[0]["model"] is None else int(results[0]["model"]["samples"]),
        "pre-training collisions": 0 if results[0]["model"] is None else int(results[0]["model"]["collisions"]),
    }


def table(results: Iterable[Result]) -> dict[str, Any]:
    """Return all figures of one robot, by part (training, arenas, deployment), method and row.

    Raises:
        ValueError: the results belong to several robots, or the methods have different seeds.
    """
    cells = list(results)
    by_method = {m: [c for c in cells if c["study"]["method"] == m] for m in METHODS}
    seeds = {m: sorted(c["study"]["seed"] for c in group) for m, group in by_method.items() if group}
    robots = {c["study"]["robot"] for c in cells}
    if len(robots) != 1 or len({tuple(s) for s in seeds.values()}) != 1:
        raise ValueError(f"not the same seeds of one robot: {robots}, {seeds}")
    groups = {m: sorted(g, key=lambda c: int(c["study"]["seed"])) for m, g in by_method.items() if g}
    parts: dict[str, dict[str, Row]] = {"training": {m: training_rows(group) for m, group in groups.items()}}
    for arena in cells[0]["study"]["arenas"]:
        parts[arena] = {m: evaluation_rows(g, f"{TRAINED}-{m}-{arena}") for m, g in groups.items()}
    parts["deployment"] = _deployment(groups, cells[0]["study"]["arenas"][0])
    study = cells[0]["study"]
    return {
        "robot": robots.pop(),
        "seeds": next(iter(seeds.values())),
        "steps": study["steps"],
        "episodes": study["episodes"],
        "parts": parts,
    }


def _deployment(groups: dict[str, list[Result]], arena: str) -> dict[str, Row]:
    """Return the rows for a filter that is added or removed after training, and for an untrained policy."""
    rows = {}
    for name, method, trial in (
        ("trained without, run with the filter", NONE, f"{TRAINED}-{DDPC}-{arena}"),
        ("trained with, run without the filter", DDPC, f"{TRAINED}-{NONE}-{arena}"),
        ("untrained, run with the filter", DDPC, f"{UNTRAINED}-{DDPC}-{arena}"),
    ):
        if method in groups:
            rows[name] = evaluation_rows(groups[method], trial)
    return rows


def plain(value: Any) -> Any:
    """Convert estimates to JSON values."""
    if isinstance(value, MeanEstimate):
        return {"value": value.value, "low": value.low, "high": value.high, "seeds": list(value.seeds)}
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    return value


def without_times(value: Any) -> Any:
    """Remove the times: the rest must be equal in two comparisons from the same seeds."""
    if isinstance(value, dict):
        return {name: without_times(inner) for name, inner in value.items() if not name.endswith("[ms]")}
    return value


PERCENT = ("goal rate", "collision rate", "interventions", *TOUCHED)


def written(name: str, value: Any) -> str:
    """Format a figure for the table, with its interval in brackets."""
    form: Callable[[float], str]
    if name in PERCENT:
        form = lambda v: f"{100.0 * v:.1f}"  # noqa: E731
    elif "speed" in name:
        form = lambda v: f"{v:.3g}"  # noqa: E731
    elif "[ms]" in name:
        form = lambda v: f"{v:.2f}"  # noqa: E731
    else:
        form = lambda v: f"{v:.0f}"  # noqa: E731
    unit = " %" if name in PERCENT else ""
    if isinstance(value, MeanEstimate):
        return f"{form(value.value)}{unit} [{form(value.low)}, {form(value.high)}]"
    return form(float(value)) + unit


PAPER_ROWS = {
    "goal rate": ("goal", 0.01),
    "collision rate": ("collision", 0.01),
    "mean speed [m/s]": ("mean_speed", 1.0),
    "max speed [m/s]": ("max_speed", 1.0),
    "mean reward": ("reward", 1.0),
}


def _paper(robot: str, row: str, method: str) -> str:
    """Return the paper's figure for a row, or an empty string."""
    published = json.loads(PAPER.read_text()).get(robot, {}).get(method)
    if published is None:
        return ""
    if row == "decision [ms]":
        return f"{published['decision_ms'][0]:.1f}"
    if row == "its std [ms]":
        return f"{published['decision_ms'][1]:.1f}"
    if row not in PAPER_ROWS:
        return ""
    name, factor = PAPER_ROWS[row]
    return written(row, published[name] * factor)


def markdown(figures: dict[str, Any]) -> str:
    """Return the tables of one robot as Markdown, with the paper's figures in italics."""
    robot, lines = figures["robot"], []
    seeds = ", ".join(map(str, figures["seeds"]))
    lines += [
        f"# {robot}",
        "",
        f"{figures['steps']} training steps, seeds {seeds}; {figures['episodes']} episodes a seed, the same for all "
        "methods. In brackets: 95 % intervals by the hierarchical bootstrap (seed, then episode). In italics: the "
        "paper's figures, of its own task. Decision times are of policy and method together.",
        "",
    ]
    for part, methods in figures["parts"].items():
        columns = list(methods)
        heads = [NAMES.get(column, column) for column in columns]
        lines += [f"## {part}", "", "| | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
        for row in next(iter(methods.values()), {}):
            shown = [written(row, methods[column][row]) for column in columns]
            lines.append(f"| {row} | " + " | ".join(shown) + " |")
            beside = [_paper(robot, row, column) for column in columns]
            if part not in ("training", "deployment") and any(beside):
                lines.append("| *paper* | " + " | ".join(f"*{text}*" for text in beside) + " |")
        lines.append("")
    return "\n".join(lines)
