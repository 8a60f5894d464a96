"""Compare the measurement errors of a description with a log: how far a measured pose moves while the robot stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brakeline.deploy.data.sources.quantity_names import column_names, column_units
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.dataset import Trajectory

STOOD = 2.0  # s without an input, or the periods of a plan, after which a robot stands
FEWEST = 20  # periods of standing that show the noise


def small_errors(robot: Robot, parts: Sequence[Trajectory]) -> list[str]:
    """Return a note on each coordinate of the pose whose stated error is smaller than its noise at rest.

    Two measurements of one position are at most twice the measurement error apart.
    """
    rest = max(round(STOOD / robot.period), robot.horizon)
    moved = [_moved_at_rest(robot, t, rest) for t in parts]
    differences = np.concatenate([np.zeros((0, len(robot.state))), *moved])
    if len(differences) < FEWEST:
        return []
    noise = 0.5 * np.quantile(np.abs(differences), 0.99, axis=0)
    names, units = column_names(robot)[0], column_units(robot)
    pose = [*range(robot.position_dim), *([] if robot.heading is None else [robot.heading])]
    return [
        f"{names[i]} varies by ±{noise[i]:.2g} {units[names[i]]} while the robot stands, but the description states "
        f"`error = {robot.measurement_bound[i]:g}`: write the largest difference from the true value"
        for i in pose
        if noise[i] > robot.measurement_bound[i]
    ]


def _moved_at_rest(robot: Robot, t: Trajectory, rest: int) -> Array:
    """Return the changes of the states (n, d) in the periods that follow `rest` periods without an input."""
    idle = np.concatenate([[0], np.cumsum(robot.is_stop_input(t.inputs))])
    at = np.arange(rest, len(t.inputs))
    changes: Array = np.diff(t.states, axis=0)
    return np.asarray(changes[at[idle[at + 1] - idle[at - rest] == rest + 1]])
