"""A picture of what a data set covers: where it was driven, and each input with what follows it, within the bounds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brakeline.deploy.data.coverage import Coverage
from brakeline.deploy.data.sources.quantity_names import column_names, split
from brakeline.messaging.robot import Array
from brakeline.safety.model.dataset import Dataset


def draw_coverage(data: Dataset, told: Coverage, path: Path) -> None:
    """Writes a PNG (or what the file's ending says)."""
    robot = data.robot
    inputs = column_names(robot)[1]
    wide = 1 + robot.action_dim
    figure = Figure(figsize=(4.2 * wide, 4.4), layout="constrained")
    axes = figure.subplots(1, wide)
    _way(axes[0], data)
    for i, ax in enumerate(axes[1:]):
        unit = split(robot.action[i])[1]
        follower = robot.follows[i]
        driven = np.concatenate([t.inputs[:, i] for t in data.trajectories])
        if follower >= 0:
            moved = np.concatenate([t.states[1:, follower] for t in data.trajectories])
            ax.plot(driven, moved, ".", markersize=2, alpha=0.4)
            ax.set_ylabel(f"{robot.state[follower]}, a period later")
        else:
            ax.hist(driven, bins=40)
            ax.set_ylabel("periods")
        for bound in (robot.action_low[i], robot.action_high[i]):
            ax.axvline(bound, color="k", linewidth=0.8, linestyle="--")
        ax.set_xlabel(f"{inputs[i]} [{unit}]")
    title = f"{robot.name}: {data.periods} periods, {told.stops} stops"
    figure.suptitle("\n".join([title, *(f"missing: {text}" for text in told.missing[:4])]), fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _way(ax: Axes, data: Dataset) -> None:
    for t in data.trajectories:
        at: Array = t.states
        ax.plot(at[:, 0], at[:, 1], linewidth=0.7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(data.robot.state[0])
    ax.set_ylabel(data.robot.state[1])
