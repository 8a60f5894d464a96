"""Fit a one-step predictor to recorded driving, and bound the error of its rollouts (docs/method.md §13).

Every recorded period fits the predictor, and every window of a plan's length calibrates the bound: the recording is
cut into folds, and a predictor that did not see a fold predicts the windows in it (cross-conformal calibration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadData, ErrorBoundError
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.driving_kinds import driving_kinds
from brakeline.safety.model.error_bounds import RESIDUAL, ErrorBound
from brakeline.safety.model.fitting import stopping_distance_of_stops
from brakeline.safety.model.model_config import FREE, ONE_STEP, ModelConfig
from brakeline.safety.model.model_set import ModelSet, extra_coordinates
from brakeline.safety.model.one_step import Features, OneStep, features_for
from brakeline.safety.model.set_factors import SetFactors
from brakeline.safety.model.set_shape import (
    MOST_FOR_SHAPE,
    RARE,
    Shape,
    plans_from,
    shape_with_chords,
    shares,
    spread_features,
    stop_from_full_speed,
)
from brakeline.safety.model.windows import displacement, predicted_outputs, way_after_rest, ways

Array = NDArray[np.float64]
Index = NDArray[np.int64]

Progress = Callable[[float], None]  # called with the share of the work that is done
CHOSEN, WEIGHED, SCORED = 0.5, 0.7, 0.95  # shares of the work that are done after each part

FOLDS = 5
DEGREES, LAGS, RIDGES = (1, 2, 3), (0, 1), (1e-8, 1e-5, 1e-3)
FEWEST_PERIODS_A_FEATURE = 10  # of candidates with more features, nothing could be said
SIMPLER = 1.03  # a simpler candidate wins if its error is at most this factor larger
WEIGHTS = (3.0, 10.0, 30.0)  # of the leverage
MOST_TO_CHOOSE = 10_000  # windows by which candidates are compared
FEWEST_ENDS = 20  # windows that end in a stop, to fit how the way after it depends on the driving before
QUANTILE = 0.99  # of the out-of-fold errors, by which candidates are compared


@dataclass(frozen=True)
class Samples:
    """Recorded driving, cut into folds.

    Attributes:
        v (P, v), y (P, n), period_fold (P,): all periods: variables [s; u; input of the period before] and outputs.
        z (T, nz), after (T, N, n + d·discs), chords (T, N), stops (T,), fold (T,), start (T, 2): all windows of N
            periods that lie in one fold: regressors, outputs after each period, chord deviations [m], the way after the
            window [m] if it ends in a stop, otherwise NaN, trajectory and first period.
    """

    v: Array
    y: Array
    period_fold: Index
    z: Array
    after: Array
    chords: Array
    stops: Array
    fold: Index
    start: Index


def samples_of(data: Dataset, folds: int = FOLDS) -> Samples:
    """Cut recorded driving into periods and windows, each with its fold.

    With many trajectories, a fold consists of whole trajectories; otherwise, of one block of each trajectory.

    Raises:
        BadData: a fold holds no window; the message says how much driving is missing.
    """
    robot, N = data.robot, data.robot.horizon
    whole = len(data.trajectories) >= 4 * folds
    parts: list[tuple[NDArray[Any], ...]] = []
    for number, t in enumerate(data.trajectories):
        periods = len(t.inputs)
        block = np.full(periods, number % folds) if whole else np.arange(periods) * folds // periods
        parts.append((*_periods(robot, t), block, *_windows(data, t, number, block)))
    names = ("v", "y", "period_fold", "z", "after", "chords", "stops", "fold", "start")
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    samples = Samples(**dict(zip(names, columns, strict=True)))
    if len(np.unique(samples.fold)) < folds:
        needed = 4 * folds * N * robot.period / 60.0
        raise BadData(f"too little driving to calibrate with: record at least {needed:.1f} minutes")
    return samples


def _before(robot: Robot, t: Trajectory) -> Array:
    """Return the input in force at each period's start (T, m)."""
    first = np.zeros(robot.action_dim) if t.before is None else t.before
    return np.vstack([first, t.inputs[:-1]])


def _periods(robot: Robot, t: Trajectory) -> tuple[Array, Array]:
    v = np.hstack([t.states[:-1, list(robot.regressor)], t.inputs, _before(robot, t)])
    return v, displacement(robot, t.states[:-1], t.states[1:])


def _windows(
    data: Dataset, t: Trajectory, number: int, block: Index
) -> tuple[Array, Array, Array, Array, Index, Index]:
    robot, N = data.robot, data.robot.horizon
    start = np.arange(max(len(t.inputs) - N + 1, 0))
    start = start[block[start] == block[start + N - 1]]
    at = start[:, None] + np.arange(N)
    measured, inputs = t.states[start][:, list(robot.regressor)], t.inputs[at].reshape(len(at), N * robot.action_dim)
    z = np.hstack([measured, _before(robot, t)[start], inputs])
    ends = [displacement(robot, t.states[start], t.states[start + k]) for k in range(1, N + 1)]
    after = [predicted_outputs(robot, end) for end in ends]
    chords = (ways(robot, t)[0] + data.chord_deviation)[at]
    stops = way_after_rest(robot, t)[start + N]
    return z, np.stack(after, 1), chords, stops, block[start], np.column_stack([np.full(len(start), number), start])


@dataclass(frozen=True)
class Candidate:
    """A family of features, and its out-of-fold error.

    Attributes:
        error [m]: the 99 % quantile of the distance between predicted and measured position, over all windows and
            periods, each predicted without its fold. In joint space, of the largest error of a limit's value, in units
            of `Robot.limit_scales`.
        features: number of features.
    """

    degree: int
    lags: int
    saturating: bool
    ridge: float
    error: float
    features: int


@dataclass(frozen=True)
class _Regression:
    """Ridge regressions on all folds, or on all but one, from their second moments: gram (K, F, F), cross (K, F, n)."""

    features: Features
    gram: Array
    cross: Array

    @staticmethod
    def of(features: Features, s: Samples) -> _Regression:
        phi, folds = features(s.v), range(int(s.period_fold.max()) + 1)
        parts = [(phi[s.period_fold == i], s.y[s.period_fold == i]) for i in folds]
        return _Regression(features, np.array([a.T @ a for a, _ in parts]), np.array([a.T @ b for a, b in parts]))

    def fit(self, ridge: float, without: int = -1, weight: float = 0.0) -> OneStep:
        used = [i for i in range(len(self.gram)) if i != without]
        gram, cross = self.gram[used].sum(0), self.cross[used].sum(0)
        weights = ridge * np.diag(gram) + 1e-12 * gram[0, 0]
        weights[0] = 0.0  # not of the constant
        gram = gram + np.diag(weights)
        root = np.linalg.inv(np.linalg.cholesky(gram))
        return OneStep(np.linalg.solve(gram, cross).T, self.features, root, weight)

    def quality(self) -> tuple[float, float]:
        """Return the smallest singular value and the condition number of the scaled features."""
        gram = self.gram.sum(0)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(gram / np.outer(scale, scale)), 0.0))
        return float(singular[0]), float(singular[-1] / max(singular[0], 1e-300))

    def out_of_fold(self, robot: Robot, s: Samples, ridge: float) -> Array:
        """Return the errors (T, N, n + d·discs) of all windows, each predicted without its fold."""
        found = np.empty_like(s.after)
        for i in range(len(self.gram)):
            held = s.fold == i
            found[held] = s.after[held] - self.fit(ridge, without=i).rollouts(robot, s.z[held])
        return found


def unheard(share: float) -> None:
    """Ignore the progress."""


def choose(robot: Robot, s: Samples, progress: Progress = unheard) -> tuple[Candidate, list[Candidate], _Regression]:
    """Choose degree, lags, saturating features and ridge by the out-of-fold error.

    Returns:
        The choice, all candidates from the best to the worst, and the regression of the choice.
    """
    found: list[tuple[Candidate, _Regression]] = []
    some = np.linspace(0, len(s.z) - 1, min(len(s.z), MOST_TO_CHOOSE)).astype(int)
    few_windows = replace(s, z=s.z[some], after=s.after[some], fold=s.fold[some])
    families = [*product(DEGREES, LAGS, (False, True))]
    for number, (degree, lags, saturating) in enumerate(families):
        progress(CHOSEN * number / len(families))
        features = features_for(robot, s.v, degree, lags, saturating)
        count = len(features.terms)
        few = degree > 1 and len(s.v) < FEWEST_PERIODS_A_FEATURE * count
        if few or (saturating and not len(features.saturations)):
            continue
        regression = _Regression.of(features, s)
        for ridge in RIDGES:
            off = _distances(robot, regression.out_of_fold(robot, few_windows, ridge))
            with np.errstate(invalid="ignore"):
                error = float(np.quantile(off, QUANTILE))
            found.append((Candidate(degree, lags, saturating, ridge, error, count), regression))
    found = [pair for pair in found if np.isfinite(pair[0].error)]
    least = min(c.error for c, _ in found)
    good = [pair for pair in found if pair[0].error <= SIMPLER * least]
    chosen, regression = min(good, key=lambda pair: (pair[0].features, pair[0].error))
    return chosen, sorted((c for c, _ in found), key=lambda c: c.error), regression


def _distances(robot: Robot, errors: Array) -> Array:
    """Return the error of the position (...,) [m], or in joint space the largest of a limit, of errors (..., n')."""
    if not robot.position_dim:
        return np.asarray(np.abs(robot.limit_values(errors)).max(-1))
    with np.errstate(over="ignore", invalid="ignore"):  # a rollout may diverge
        return np.asarray(np.linalg.norm(errors[..., : robot.position_dim], axis=-1))


@dataclass(frozen=True)
class Calibration:
    """How the predictor of one period was chosen, and how far its sets had to be widened.

    Attributes:
        chosen, candidates: the choice, and all candidates from the best to the worst.
        factor: factor on the final shape of positions and chord deviations, from the out-of-fold scores.
        scores (T,): how much of its sets every window used; above 1, a part of the window is outside.
        first_scores (T,): the same for the predicted state after one period alone.
        samples: the recorded driving.
        smallest_singular, condition: of the chosen features, each scaled to its root mean square.
    """

    chosen: Candidate
    candidates: tuple[Candidate, ...]
    factor: float
    scores: Array
    first_scores: Array
    samples: Samples
    smallest_singular: float
    condition: float


def fit_one_step(
    data: Dataset, model_config: ModelConfig, progress: Progress = unheard
) -> tuple[ModelSet, Calibration]:
    """Fit a model set of mode one-step to recorded driving of any kind.

    The score of a window is the largest ratio of an error to a shape. Predictor and shape come from the other folds.
    `progress` is called with the share of the work that is done.

    Raises:
        BadData: there is too little driving, or too few stops; the message says what to record.
        ErrorBoundError: the robot stops by feedback, so its plans are no affine map of the inputs.
    """
    robot = data.robot
    if robot.feedback:
        raise ErrorBoundError("what a feedback makes of the state has to be recorded: use mode direct")
    s = samples_of(data.joined())
    chosen, candidates, regression = choose(robot, s, progress)
    progress(CHOSEN)
    weight, speeds = _weight_and_speeds(robot, s, regression, chosen.ridge, model_config.outside)
    scores, positions, others = _scores(robot, s, regression, chosen.ridge, weight, speeds, progress)
    kinds = driving_kinds(robot, s.z, s.start)
    joint_space = not robot.position_dim  # the limited coordinates are scored with the plan
    factors = SetFactors.of(scores, others, kinds, model_config.outside, same=joint_space)
    one_step = replace(regression.fit(chosen.ridge, weight=weight), start=factors.start)
    errors = (s.after - one_step.rollouts(robot, s.z)) / one_step.stretches(robot, s.z)[..., None]
    shape = shape_with_chords(robot, s.z, errors, s.chords, speeds)
    n, d, N = s.after.shape[2], robot.position_dim, robot.horizon
    scale = np.full(n, factors.plan)
    first_scale = np.where(np.arange(n) < d, factors.plan, factors.first)
    steps = tuple(shape.bound(robot, k, slice(n), scale if k > 1 else first_scale) for k in range(1, N + 1))
    chords = [shape.bound(robot, k, slice(n, n + 1), scale[:1]) for k in range(1, N + 1)]
    measured = len(robot.regressor)
    known = np.hstack([s.v[:, :measured], s.v[:, measured + robot.action_dim :]])  # without the period's own input
    model = ModelSet(
        robot,
        replace(model_config, mode=ONE_STEP, windows=FREE, certificate=RESIDUAL),
        steps,
        _stacked(chords),
        _stopping_distance(data, s, model_config),
        np.stack([known.min(0), known.max(0)]),
        np.eye(s.z.shape[1]),
        data.about | {"data": data.digest(), "periods": str(data.periods)},
        one_step=one_step,
    )
    used, used_first = (factors.shares(part, others, kinds) for part in (scores, positions))
    return model, Calibration(chosen, tuple(candidates), factors.plan, used, used_first, s, *regression.quality())


def _stacked(bounds: list[ErrorBound]) -> ErrorBound:
    """Return bounds of one coordinate each, with the same W, as one bound."""
    C, M, kappa = (np.vstack([getattr(one, name) for one in bounds]) for name in ("C", "M", "kappa"))
    return ErrorBound(C, bounds[0].W, M, kappa, np.concatenate([one.w for one in bounds]), np.eye(len(bounds)))


def _stopping_distance(data: Dataset, s: Samples, model_config: ModelConfig) -> ErrorBound:
    """Return the bound of the way after a plan's end, from all windows that end in a stop.

    Raises:
        BadData: there are too few stops; the message says what to record.
    """
    largest = stopping_distance_of_stops(data, model_config)
    ended = ~np.isnan(s.stops)
    if int(ended.sum()) < FEWEST_ENDS:
        spread = np.zeros((data.robot.horizon, 1, spread_features(data.robot, s.z[:1]).shape[2]))
        shape = Shape(spread, np.full((data.robot.horizon, 1), largest))
    else:
        ways_on = np.repeat(s.stops[ended, None, None], data.robot.horizon, axis=1)
        shape = Shape.around(data.robot, s.z[ended], ways_on, model_config.inflation)
    return shape.bound(data.robot, data.robot.horizon, slice(1), np.ones(1))


def _weight_and_speeds(
    robot: Robot, s: Samples, regression: _Regression, ridge: float, outside: float
) -> tuple[float, bool]:
    """Return the weight of the leverage, and whether half-widths grow with the speeds, for the narrowest sets of plans.

    What counts are the last sets, on average of plans and of a stop from full speed. Of several nearly as narrow, take
    the largest weight. Slopes on the speeds must be worth it.
    Without the leverage, one factor widens all sets because some windows at the edge of the data are predicted badly,
    and sets outside of the data are as narrow as within. Minutes of driving may hold few errors at a large speed that
    the inputs do not announce, such as the sway of a boat: then a slope on that speed is mostly noise.
    """
    some = np.linspace(0, len(s.z) - 1, min(len(s.z), MOST_FOR_SHAPE)).astype(int)
    used = [*range(robot.position_dim)] or [*extra_coordinates(robot)]
    z, after, fold = s.z[some], s.after[some, -1:][..., used], s.fold[some]
    plans, full, pairs = plans_from(robot, z), stop_from_full_speed(robot, z), [*product(WEIGHTS, (True, False))]
    scores, sums = np.zeros((len(pairs), len(z))), np.zeros(len(pairs))
    for i in range(len(regression.gram)):
        one_step, held = regression.fit(ridge, i), fold == i
        off = after - one_step.rollouts(robot, z)[:, -1:][..., used]
        leverages, *of_plans = (one_step.leverages(robot, one)[:, -1:] for one in (z, plans, full))
        for p, (weight, speeds) in enumerate(pairs):
            errors = off / np.sqrt(1.0 + weight * leverages)[..., None]
            shape = Shape.around(robot, z[~held], errors[~held], last=True, speeds=speeds, outside=RARE)
            scores[p, held] = shape.scores(robot, z[held], errors[held], last=True)
            for some_plans, leverage in zip((plans, full), of_plans, strict=True):
                wide = shape.widths(robot, some_plans, last=True)[:, 0] * np.sqrt(1.0 + weight * leverage)
                sums[p] += wide.mean()
    found = dict(zip(pairs, np.maximum(np.quantile(scores, 1.0 - outside, axis=1), 1.0) * sums, strict=True))
    least = {speeds: min(width for pair, width in found.items() if pair[1] == speeds) for speeds in (True, False)}
    speeds = bool(least[False] > SIMPLER * least[True])
    return max(w for w in WEIGHTS if found[w, speeds] <= SIMPLER * least[speeds]), speeds


def _scores(
    robot: Robot,
    s: Samples,
    regression: _Regression,
    ridge: float,
    weight: float,
    speeds: bool,
    progress: Progress,
) -> tuple[Array, Array, Array]:
    """Return three scores (T,) of each window, from the folds that it is not in.

    Returns:
        The largest ratio of positions, coordinates that a limit needs and chord deviations; the same for the positions
        after one period; and that of the other coordinates after one period.
    """
    d, scores = robot.position_dim, np.zeros((3, len(s.z)))
    for_plan = [*range(d), *extra_coordinates(robot), -1]
    for i in range(len(regression.gram)):
        progress(WEIGHED + (SCORED - WEIGHED) * i / len(regression.gram))
        held = s.fold == i
        one_step = regression.fit(ridge, i, weight)
        errors = (s.after - one_step.rollouts(robot, s.z)) / one_step.stretches(robot, s.z)[..., None]
        shape = shape_with_chords(robot, s.z[~held], errors[~held], s.chords[~held], speeds)
        widths = shape.widths(robot, s.z[held])
        used = shares(np.concatenate([np.abs(errors[held]), s.chords[held, :, None]], axis=2), widths)
        scores[0, held] = used[..., for_plan].max((1, 2))
        scores[1, held] = used[:, 0, :d].max(1, initial=0.0)
        scores[2, held] = used[:, 0, d:-1].max(1, initial=0.0)
    return scores[0], scores[1], scores[2]
