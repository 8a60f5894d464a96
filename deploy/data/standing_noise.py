"""Compare the measurement errors that a description states with how much the pose in a log varies at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brakeline.deploy.data.sources.quantity_names import column_names, column_units
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.dataset import Trajectory

STOOD = 2.0  # s without an input, and at least the length of a plan, after which a robot stands
FEWEST = 20  # periods at rest; fewer of them do not show the noise


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
        f"`error = {robot.measurement_bound[i]:g}`: write the largest difference from the true value as its error"
        for i in pose
        if noise[i] > robot.measurement_bound[i]
    ]


def _moved_at_rest(robot: Robot, t: Trajectory, rest: int) -> Array:
    """Return the changes of the states (k, n) in periods without an input, after `rest` periods without one."""
    idle_before = np.concatenate([[0], np.cumsum(robot.is_stop_input(t.inputs))])  # number of such periods
    periods = np.arange(rest, len(t.inputs))
    at_rest = idle_before[periods + 1] - idle_before[periods - rest] == rest + 1
    changes: Array = np.diff(t.states, axis=0)
    return np.asarray(changes[periods[at_rest]])
