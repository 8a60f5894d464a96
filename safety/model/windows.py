"""Cut recorded data into windows, to which model sets are fitted (docs/method.md §2).

A window has a state, the inputs after it, and the state after these inputs.

A *plan window* of length k starts at a period whose inputs follow the robot's schedule (chosen inputs, then its stop
rules) for k periods. A *free window* starts at any period, and all of its inputs are regressors. Displacement is in
the robot's frame at the window's start, so position is no regressor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadData
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import INPUT_TOLERANCE, Array, Robot
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.model_config import FREE as FREE
from brakeline.safety.model.model_config import PLAN as PLAN
from brakeline.safety.model.model_config import ModelConfig

FEWEST_WINDOWS = ModelConfig.fewest
WORST_CONDITION = 1e4  # of the whitened regressors' second moment


@dataclass(frozen=True)
class Windows:
    """Windows of k periods of recorded data (docs/method.md §2).

    Attributes:
        z (T, nz): regressors [x_0; u_{-1}; inputs].
        y (T, n): state after k periods, in the frame of the start: displacement, change of heading, other values.
        chord_deviation (T,) [m]: largest distance of the path from its chord, in the last period.
        stopping_distance (T,) [m]: way after the window while the inputs stay those of a stop, otherwise NaN.
        start (T, 2): trajectory and period.
    """

    z: Array
    y: Array
    chord_deviation: Array
    stopping_distance: Array
    start: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.z)

    def take(self, index: NDArray[np.bool_]) -> Windows:
        return Windows(
            self.z[index], self.y[index], self.chord_deviation[index], self.stopping_distance[index], self.start[index]
        )


def displacement(robot: Robot, start: Array, end: Array) -> Array:
    """Return state `end` (..., n) with position and heading relative to `start` (..., n), in the frame of the start."""
    seen = end.copy()
    position = end[..., : robot.position_dim] - start[..., : robot.position_dim]
    if robot.heading is not None:
        position = rotate(position, -start[..., robot.heading])
        turn = end[..., robot.heading] - start[..., robot.heading]
        seen[..., robot.heading] = (turn + np.pi) % (2.0 * np.pi) - np.pi
    seen[..., : robot.position_dim] = position
    return seen


def windows(data: Dataset, k: int, kind: str = PLAN) -> Windows:
    """Return all windows of k periods within a trajectory; raise BadData without any trajectory."""
    if not data.trajectories:
        raise BadData("no trajectory: record more of them")
    cut = _plans_of if kind == PLAN else _free_of
    parts = [_windows_of(data, t, k, i, *cut(data.robot, t, k)) for i, t in enumerate(data.trajectories)]
    return Windows(
        *(
            np.concatenate([getattr(p, n) for p in parts])
            for n in ("z", "y", "chord_deviation", "stopping_distance", "start")
        )
    )


def recorded_domain(data: Dataset) -> Array:
    """Return the smallest and the largest [x_0; input in force] (2, regressor_dim) in the data."""
    known = windows(data, 1).z[:, : data.robot.regressor_dim]
    return np.stack([known.min(0), known.max(0)])


def plan_regressor_map(robot: Robot) -> Array:
    """Return T with z' = T z, from the regressors of a plan window to those of a free window."""
    known, S = robot.regressor_dim, robot.plan_matrix()
    T = np.eye(known + len(S), known + S.shape[1])
    T[known:, known:] = S
    return T


def _plans_of(robot: Robot, t: Trajectory, k: int) -> tuple[NDArray[np.intp], Array]:
    """Return the starts of plan windows of k periods, and their free inputs (T, F·m)."""
    m, free = robot.action_dim, robot.free_steps
    count = max(len(t.inputs) - k + 1, 0)
    padded = np.vstack([t.inputs, np.zeros((free, m))])  # the free inputs beyond k play no part
    chosen = np.hstack([padded[j : j + count] for j in range(free)])
    planned = chosen @ robot.plan_matrix()[: k * m].T
    actual = np.hstack([t.inputs[j : j + count] for j in range(k)]).reshape(count, k * m)
    if robot.feedback:
        braked = _braked(robot, t)
        for j in range(1, k):
            row = slice(j * m, (j + 1) * m)
            planned[:, row] = np.where(robot.stops_by_feedback, braked[j : j + count], planned[:, row])
        near = np.tile(INPUT_TOLERANCE * (robot.high() - robot.low()), k)
    else:
        near = np.full(k * m, 1e-9)
    start = np.flatnonzero((np.abs(planned - actual) < near).all(1))
    return start, chosen[start]


def _free_of(robot: Robot, t: Trajectory, k: int) -> tuple[NDArray[np.intp], Array]:
    """Return all starts, and all inputs of the horizon (T, N·m), zero from input k on."""
    m = robot.action_dim
    count = max(len(t.inputs) - k + 1, 0)
    inputs = np.zeros((count, robot.horizon * m))
    for j in range(k):
        inputs[:, j * m : (j + 1) * m] = t.inputs[j : j + count]
    return np.arange(count), inputs


def _windows_of(data: Dataset, t: Trajectory, k: int, number: int, start: NDArray[np.intp], chosen: Array) -> Windows:
    robot = data.robot
    z = np.hstack([t.states[start][:, list(robot.regressor)], t.in_force()[start], chosen])
    y = displacement(robot, t.states[start], t.states[start + k])
    off, travel = ways(robot, t)
    chord_deviation = (off + data.chord_deviation)[start + k - 1]
    stopping_distance = travel[np.minimum(start + k, len(t.inputs))]
    return Windows(z, y, chord_deviation, stopping_distance, np.column_stack([np.full(len(start), number), start]))


def ways(robot: Robot, t: Trajectory) -> tuple[Array, Array]:
    """Return the chord deviation of each period and the stopping distance from each sample on.

    In joint space they are the excursions of the limits (`_excursions`). The result is cached for each trajectory,
    since windows of all lengths need it.

    Returns:
        The largest distance of the path from its chord (T,) [m], and the way while stopping (T+1,) [m]; NaN where the
        inputs are not those of a stop.
    """
    known = _found.get(t)
    if known is None or known[0] != robot:
        if robot.position_dim:
            known = _found[t] = robot, _farthest_off_chord(robot, t), _rest_travel(robot, t)
        else:
            known = _found[t] = robot, *_excursions(robot, t)
    return known[1:]


_found: WeakKeyDictionary[Trajectory, tuple[Robot, Array, Array]] = WeakKeyDictionary()


def _braked(robot: Robot, t: Trajectory) -> Array:
    """Return the inputs (T, m) that the stop rules give for each state while braking."""
    return robot.stop_by_feedback(np.zeros_like(t.inputs), t.states[:-1], t.in_force())


def stop_input_periods(robot: Robot, t: Trajectory) -> NDArray[np.bool_]:
    """Return the periods (T,) in which the inputs are those of a stop."""
    if not robot.feedback:
        return robot.is_stop_input(t.inputs)
    near = INPUT_TOLERANCE * (robot.high() - robot.low())
    return np.asarray((np.abs(t.inputs - _braked(robot, t)) < near)[:, robot.zero_at_rest].all(1))


def predicted_outputs(robot: Robot, y: Array) -> Array:
    """Append the displacements of the body's further discs to y.

    Args:
        robot: the robot.
        y (T, n): state after a window, in the frame of its start.

    Returns:
        Array (T, n + d·discs): y, then the displacement of each disc whose centre is not the regressed position, in the
        frame of the start [m].
    """
    if robot.heading is None:
        return y
    arms = [np.asarray(disc.at) for disc in robot.body if disc.arm > 0.0]
    moved = [y[:, : robot.position_dim] + rotate(np.tile(arm, (len(y), 1)), y[:, robot.heading]) - arm for arm in arms]
    return np.hstack([y, *moved])


def _farthest_off_chord(robot: Robot, t: Trajectory) -> Array:
    """Return the largest distance (T,) of the centers of the body's discs from their chords in each period.

    Between two samples, a center may leave its chord by as much as the heading changes there.
    """
    off = _off_chord(t.paths)
    arms = [np.asarray(disc.at) for disc in robot.body if disc.arm > 0.0]
    if t.headings is None or robot.heading is None:
        return off + max(disc.arm for disc in robot.body) * np.abs(t.turned)
    steps = np.abs(np.diff(t.headings, axis=1, prepend=0.0)).max(1)
    for arm in arms:
        swung = rotate(np.broadcast_to(arm, t.paths.shape), t.headings) - arm
        off = np.maximum(off, _off_chord(t.paths + swung) + np.linalg.norm(arm) * steps)
    return off


def _off_chord(paths: Array) -> Array:
    """Return the largest distance (T,) of positions (T, S, d) within a period from its chord."""
    chord = paths[:, -1:]
    length2 = np.maximum((chord**2).sum(-1, keepdims=True), 1e-18)
    along = np.clip((paths * chord).sum(-1, keepdims=True) / length2, 0.0, 1.0)
    return np.asarray(np.sqrt(((paths - along * chord) ** 2).sum(-1)).max(1))


def _excursions(robot: Robot, t: Trajectory) -> tuple[Array, Array]:
    """Return how far the values of the limits exceed those at the periods' ends, in units of `Robot.limit_scales`.

    Returns:
        The most by which any limit's value within a period exceeds the larger of its values at the period's two ends
        (T,). The most by which it grows from each sample on while the inputs stay those of a stop (T+1,); NaN where
        they are not.
    """
    values, travel = robot.limit_values(t.paths), np.full(len(t.inputs) + 1, np.nan)
    within = (values - np.maximum(values[:, -1:], 0.0)).max((1, 2))
    start = robot.limit_values(t.states[:-1])
    highest = start + values.max(1)
    for begin, end in _stops(robot, t):
        later = np.maximum.accumulate(highest[begin:end][::-1])[::-1]
        travel[begin:end] = np.maximum(later - start[begin:end], 0.0).max(1)
    return np.maximum(within, 0.0), travel


def _stops(robot: Robot, t: Trajectory) -> list[tuple[int, int]]:
    """Return the first period of each stop, and the first one after it."""
    zero = stop_input_periods(robot, t)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], zero, [False]]).astype(int))).tolist()
    return list(zip(runs[::2], runs[1::2], strict=True))


def _rest_travel(robot: Robot, t: Trajectory) -> Array:
    """Return the way (T+1,) [m] from each period on while the inputs stay those of a stop; NaN if they are not."""
    travel = np.full(len(t.inputs) + 1, np.nan)
    arm = max(disc.arm for disc in robot.body)
    for begin, end in _stops(robot, t):
        turned = np.concatenate([[0.0], np.cumsum(t.turned[begin:end])[:-1]])
        paths = t.paths[begin:end]
        if paths.shape[-1] >= 2:
            paths = rotate(paths, np.broadcast_to(turned[:, None], paths.shape[:2]))
        ends = np.vstack([np.zeros((1, paths.shape[-1])), np.cumsum(paths[:, -1], 0)])
        points = paths + ends[:-1, None]
        for at in range(begin, end):
            reach = points[at - begin :] - ends[at - begin]
            travel[at] = np.sqrt((reach**2).sum(-1)).max()
            if arm:
                travel[at] += arm * np.abs(np.cumsum(t.turned[at:end])).max()
    return travel


def resting_periods_at_end(robot: Robot) -> int:
    """Return how many of the last inputs of a plan are those of a stop, at least one."""
    left = robot.stop_profile()[:, robot.zero_at_rest]
    moving = np.flatnonzero(np.abs(left).max(1, initial=0.0) > 0.0)
    return max(robot.horizon - robot.free_steps - int(moving[-1]), 1)


def periods_until_standing(whole: Windows, data: Dataset, kind: str) -> int:
    """Return the number of periods after which the robot stood in every recorded plan, and went on standing.

    The robot stands if every measured speed is within its measurement error of zero, and its pose is that of the plan's
    end, within the errors of both measurements. A description need not name every speed.

    Args:
        whole: windows over all periods of a plan.
        data: the data set of these windows.
        kind: `PLAN` or `FREE`.

    Returns:
        A number of periods. It is the horizon for `FREE` windows, and if the robot still moved at a plan's last period.
    """
    robot, N, heading = data.robot, data.robot.horizon, data.robot.heading
    if kind != PLAN:
        return N
    error = np.asarray(robot.measurement_bound)
    plans = np.array([data.trajectories[number].states[start : start + N + 1] for number, start in whole.start])
    left = plans - plans[:, -1:]  # the way to the plan's end
    speeds, pose = list(robot.regressor), list(range(robot.position_dim))
    if heading is not None:
        left[..., heading] = (left[..., heading] + np.pi) % (2.0 * np.pi) - np.pi
        pose.append(heading)
    moves = (np.abs(plans[..., speeds]) > error[speeds]).any(2) | (np.abs(left[..., pose]) > 2.0 * error[pose]).any(2)
    return min(int(np.flatnonzero(moves.any(0)).max(initial=0)) + 1, N)


def stopping_distances(robot: Robot, t: Trajectory, rested: int) -> Array:
    """Return the ways [m] after all times at which the inputs had been those of a stop for `rested` periods."""
    travel = ways(robot, t)[1]
    return np.asarray(travel[(_periods_of_rest(robot, t) == rested) & ~np.isnan(travel)])


def way_after_rest(robot: Robot, t: Trajectory) -> Array:
    """Return the way (T+1,) [m] from each sample on, if the inputs had been those of a stop as at a plan's end.

    NaN if they had not, or if they are not while the way goes on.
    """
    rested = _periods_of_rest(robot, t) >= resting_periods_at_end(robot)
    return np.where(rested, ways(robot, t)[1], np.nan)


def _periods_of_rest(robot: Robot, t: Trajectory) -> NDArray[np.intp]:
    """Return for each sample (T+1,) for how many periods the inputs had been those of a stop."""
    lasted = np.zeros(len(t.inputs) + 1, dtype=np.intp)
    for i, rests in enumerate(stop_input_periods(robot, t)):
        lasted[i + 1] = lasted[i] + 1 if rests else 0
    return lasted


def non_overlapping(w: Windows, length: int) -> Windows:
    """Return windows that do not overlap: each starts at least `length` periods after the one before."""
    return w.take(non_overlapping_starts(w.start, length))


def non_overlapping_starts(start: NDArray[np.integer[Any]], length: int) -> NDArray[np.bool_]:
    """Return which windows (T,) start at least `length` periods after the one before. start (T, 2): see `Windows`."""
    chosen = np.zeros(len(start), dtype=bool)
    last = (-1, 0)
    for i, (trajectory, period) in enumerate(start):
        if trajectory != last[0] or period >= last[1] + length:
            chosen[i] = True
            last = (trajectory, period)
    return chosen


@dataclass(frozen=True)
class RegressorQuality:
    """Number, rank and condition of regressors, each scaled by its largest value."""

    samples: int
    rank: int
    smallest: float  # singular value, per sqrt(sample)
    condition: float


def check_regressors(z: Array, name: str, fewest: int = FEWEST_WINDOWS) -> RegressorQuality:
    """Raise BadData if regressors (T, nz) are too few, rank-deficient or nearly collinear; return their quality."""
    if len(z) < fewest:
        needed = f"at least {fewest} are needed"
        raise BadData(f"{name}: {len(z)} windows, {needed}: record more, or fit with mode one-step, which needs fewer")
    scaled = z / np.maximum(np.abs(z).max(0), 1e-12)
    singular = np.linalg.svd(scaled / np.sqrt(len(z)), compute_uv=False)
    rank = int((singular > 1e-6).sum())
    condition = float(singular[0] / max(singular[-1], 1e-300))
    if rank < z.shape[1]:
        raise BadData(f"{name}: the regressors have rank {rank} of {z.shape[1]}: record more varied inputs")
    if condition > WORST_CONDITION:
        raise BadData(f"{name}: condition number {condition:.3g} is above {WORST_CONDITION:.0g}: vary the inputs more")
    return RegressorQuality(len(z), rank, float(singular[-1]), condition)
