"""Cut recorded driving into periods, which fit a one-step predictor, and windows, which calibrate its sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadData
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.windows import displacement, predicted_outputs, way_after_rest, ways

Index = NDArray[np.int64]

FOLDS = 5


@dataclass(frozen=True)
class Samples:
    """Recorded driving, cut into folds.

    Attributes:
        v (P, v), y (P, n), period_fold (P,), follows (P,): all periods: variables [s; u; input of the period before],
            outputs, and whether the period follows the one in the row before.
        z (T, nz), after (T, N, n + d·discs), chords (T, N), stops (T,), fold (T,), start (T, 2): all windows of N
            periods that lie in one fold: regressors, outputs after each period, chord deviations [m], the way after the
            window [m] if it ends in a stop, otherwise NaN, trajectory and first period.
    """

    v: Array
    y: Array
    period_fold: Index
    follows: NDArray[np.bool_]
    z: Array
    after: Array
    chords: Array
    stops: Array
    fold: Index
    start: Index


def samples_of(data: Dataset) -> Samples:
    """Cut recorded driving into periods and windows, each with its fold.

    With many trajectories, none of which is longer than a fold, a fold consists of whole trajectories; otherwise, of
    one block of each trajectory.

    Raises:
        BadData: a fold holds no window; the message says how much driving is missing.
    """
    robot, N = data.robot, data.robot.horizon
    longest = max(len(t.inputs) for t in data.trajectories)
    whole = len(data.trajectories) >= 4 * FOLDS and longest * FOLDS <= data.periods  # few gaps leave one long rest
    if longest < N:
        raise BadData(
            f"no recording without a gap is as long as a plan ({N} periods): the longest has {longest} periods. Find "
            "out what cuts the log, or choose a shorter `plan.horizon`"
        )
    parts: list[tuple[NDArray[Any], ...]] = []
    for number, t in enumerate(data.trajectories):
        periods = len(t.inputs)
        block = np.full(periods, number % FOLDS) if whole else np.arange(periods) * FOLDS // periods
        parts.append((*_periods(robot, t), block, np.arange(periods) > 0, *_windows(data, t, number, block)))
    names = ("v", "y", "period_fold", "follows", "z", "after", "chords", "stops", "fold", "start")
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    samples = Samples(**dict(zip(names, columns, strict=True)))
    if len(np.unique(samples.fold)) < FOLDS:
        needed = 4 * FOLDS * N * robot.period / 60.0
        raise BadData(f"too little driving to calibrate with: record at least {needed:.1f} minutes")
    return samples


def _periods(robot: Robot, t: Trajectory) -> tuple[Array, Array]:
    v = np.hstack([t.states[:-1, list(robot.regressor)], t.inputs, t.in_force()])
    return v, displacement(robot, t.states[:-1], t.states[1:])


def _windows(
    data: Dataset, t: Trajectory, number: int, block: Index
) -> tuple[Array, Array, Array, Array, Index, Index]:
    robot, N = data.robot, data.robot.horizon
    start = np.arange(max(len(t.inputs) - N + 1, 0))
    start = start[block[start] == block[start + N - 1]]
    at = start[:, None] + np.arange(N)
    measured, inputs = t.states[start][:, list(robot.regressor)], t.inputs[at].reshape(len(at), N * robot.action_dim)
    z = np.hstack([measured, t.in_force()[start], inputs])
    ends = [displacement(robot, t.states[start], t.states[start + k]) for k in range(1, N + 1)]
    after = [predicted_outputs(robot, end) for end in ends]
    chords = (ways(robot, t)[0] + data.chord_deviation)[at]
    stops = way_after_rest(robot, t)[start + N]
    return z, np.stack(after, 1), chords, stops, block[start], np.column_stack([np.full(len(start), number), start])
