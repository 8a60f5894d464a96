"""Plot a comparison: learning curves of all methods, performance profiles, and the rates of each seed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brakeline.deploy.experiments.bootstrap import MeanEstimate
from brakeline.deploy.experiments.compared_methods import compared, in_order
from brakeline.deploy.experiments.comparison_table import WINDOW, spans
from brakeline.logs.run_groups import METHOD_COLORS, performance_profile
from brakeline.messaging.robot import Array

PANELS = {
    "goal": "goals reached",
    "collision": "collisions so far",
    "reward": "reward of an episode",
    "interventions": "share of steps with an intervention",
}
POINTS = 200  # per curve
OWN_COLORS = ("#8c564b", "#7f7f7f", "#17becf")  # of filters that users added to the comparison


def _save(picture: Figure, png: Path) -> None:
    png.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(png, dpi=120, metadata={"Software": None})


def _smooth(values: Array) -> Array:
    """Return the moving mean over the last `WINDOW` episodes, or all of them at the start."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - WINDOW)
    return np.asarray((sums[ends] - sums[starts]) / (ends - starts))


def _lines(results: Sequence[dict[str, Any]], name: str, grid: Array) -> Array:
    """Return curves (seeds, POINTS) of a training figure over steps.

    The number of collisions grows at the end of each episode. Other figures are means over `WINDOW` episodes that
    began one after the other. A mean is drawn at the mean of their ends: in a batch, the policy changes many times
    within a long episode.
    """
    lines = []
    for result in results:
        episodes = result["training"]["episodes"]
        ends, values = spans(episodes)[1], np.array(episodes[name], float)
        if not len(ends):  # the training ended within its first episodes
            lines.append(np.full_like(grid, 0.0 if name == "collision" else np.nan))
            continue
        if name == "collision":
            order = np.argsort(ends, kind="stable")
            lines.append(np.interp(grid, ends[order], np.cumsum(values[order]), left=0.0))
            continue
        if name == "interventions":
            values = values / np.array(episodes["steps"], float)
        at, rates = _smooth(ends), _smooth(values)
        order = np.argsort(at, kind="stable")
        lines.append(np.interp(grid, at[order], rates[order], left=np.nan))
    return np.array(lines)


def learning_curves(results: Sequence[dict[str, Any]], png: Path) -> None:
    """Plot goals, collisions, rewards and interventions over training steps: thin lines per seed, thick means."""
    picture = Figure(figsize=(10.0, 7.0), layout="constrained")
    panels: list[Axes] = list(picture.subplots(2, 2, sharex=True).ravel())
    steps, colors = results[0]["study"]["steps"], _colors(result["study"]["method"] for result in results)
    grid = np.linspace(0.0, steps, POINTS)
    for axes, (name, label) in zip(panels, PANELS.items(), strict=True):
        for method, color in colors.items():
            lines = _lines([result for result in results if result["study"]["method"] == method], name, grid)
            axes.plot(grid, lines.T, color=color, alpha=0.3, linewidth=0.8)
            axes.plot(grid, lines.mean(axis=0), color=color, linewidth=2.0, label=compared(method).label)
        axes.set_title(label, fontsize=10)
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
        if name in ("goal", "interventions"):
            axes.set_ylim(-0.02, 1.02)
    panels[0].legend(loc="best", frameon=False)
    for axes in panels[2:]:
        axes.set_xlabel(f"steps (means over {WINDOW} episodes, at the mean of their ends)")
    _save(picture, png)


def profiles(goals: Mapping[str, Array], png: Path) -> None:
    """Plot performance profiles: the share of runs that reach the goal more often than a level, with 95 % bands.

    goals: shares of goals (arenas, runs) by method.
    """
    picture = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes: Axes = picture.subplots()
    for method, color in _colors(goals).items():
        profile = performance_profile(goals[method])
        axes.plot(profile["level"], profile["share"], color=color, label=compared(method).label)
        if "low" in profile:
            axes.fill_between(profile["level"], profile["low"], profile["high"], color=color, alpha=0.15, linewidth=0.0)
    axes.set_xlabel("share of goals in an evaluation")
    axes.set_ylabel("share of runs above it")
    axes.set_xlim(max(0.0, min(float(scores.min()) for scores in goals.values()) - 0.05), 1.0)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left", frameon=False)
    _save(picture, png)


def seeds_as_points(table: dict[str, Any], png: Path) -> None:
    """Plot goal and collision rates of each part: the interval as a line, each seed as a point."""
    parts = [part for part in table["parts"] if part != "deployment"]
    picture = Figure(figsize=(3.4 * len(parts), 5.6), layout="constrained")
    grid, colors = picture.subplots(2, len(parts), squeeze=False), _colors(table["seeds"])
    for column, part in enumerate(parts):
        for row, name in enumerate(("goal rate", "collision rate")):
            axes: Axes = grid[row][column]
            methods = {m: figures[name] for m, figures in table["parts"][part].items() if name in figures}
            if not methods:
                axes.set_axis_off()
                continue
            for place, (method, estimate) in enumerate(methods.items()):
                if estimate is not None:
                    _draw_estimate(axes, place, estimate, colors[method])
            axes.set_xticks(range(len(methods)), [compared(m).label for m in methods])
            axes.set_title(f"{part}: {name} [%]", fontsize=10)
            axes.grid(axis="y", alpha=0.3)
            axes.set_xlim(-0.6, len(methods) - 0.4)
            if name == "goal rate":
                axes.set_ylim(-2.0, 102.0)
            else:
                axes.set_ylim(bottom=-0.5)
    _save(picture, png)


def _colors(methods: Iterable[str]) -> dict[str, str]:
    """Return the color of each of these methods, in the order of the tables."""
    others = itertools.cycle(OWN_COLORS)
    return {method: METHOD_COLORS.get(method) or next(others) for method in in_order(methods)}


def _draw_estimate(axes: Axes, place: int, estimate: MeanEstimate, color: str) -> None:
    """Draw the interval as a line, the mean as a dash, and the seeds as points side by side to the right of them."""
    axes.plot([place, place], [100.0 * estimate.low, 100.0 * estimate.high], color=color, linewidth=2.0)
    axes.plot(place, 100.0 * estimate.value, marker="_", markersize=16, color=color)
    offsets = place + 0.22 + 0.08 * (np.arange(len(estimate.seeds)) - 0.5 * (len(estimate.seeds) - 1))
    axes.scatter(offsets, 100.0 * np.array(estimate.seeds), s=14, color=color, alpha=0.7)
