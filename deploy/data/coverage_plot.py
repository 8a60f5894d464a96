"""Plot what a data set covers: the driven paths, and each input against its follower, with the input's bounds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from brakeline.deploy.data.coverage import Coverage
from brakeline.deploy.data.sources.quantity_names import column_names, split
from brakeline.safety.model.dataset import Dataset


def draw_coverage(data: Dataset, covered: Coverage, path: Path) -> None:
    """Write the plot to `path`, in the format of its ending (PNG, for example)."""
    robot = data.robot
    inputs = column_names(robot)[1]
    panels = 1 + robot.action_dim
    figure = Figure(figsize=(4.2 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels)
    for t in data.trajectories:
        axes[0].plot(t.states[:, 0], t.states[:, 1], linewidth=0.7)
    axes[0].set_aspect("equal", adjustable="datalim")
    axes[0].set(xlabel=robot.state[0], ylabel=robot.state[1])
    for i, ax in enumerate(axes[1:]):
        follower = robot.follows[i]
        driven = np.concatenate([t.inputs[:, i] for t in data.trajectories])
        if follower >= 0:
            moved = np.concatenate([t.states[1:, follower] for t in data.trajectories])
            ax.plot(driven, moved, ".", markersize=2, alpha=0.4)
            ax.set_ylabel(f"{robot.state[follower]}, one period later")
        else:
            ax.hist(driven, bins=40)
            ax.set_ylabel("periods")
        for bound in (robot.action_low[i], robot.action_high[i]):
            ax.axvline(bound, color="k", linewidth=0.8, linestyle="--")
        ax.set_xlabel(f"{inputs[i]} [{split(robot.action[i])[1]}]")
    title = f"{robot.name}: {data.periods} periods, {covered.stops} stops"
    figure.suptitle("\n".join([title, *(f"missing: {text}" for text in covered.missing[:4])]), fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
