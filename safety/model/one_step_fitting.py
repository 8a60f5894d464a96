"""Fit a one-step predictor to recorded driving, and bound the error of its rollouts (docs/method.md §13).

Every recorded period fits the predictor, and every window of a plan's length calibrates the bound: the recording is
cut into folds, and a predictor that did not see a fold predicts the windows in it (cross-conformal calibration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from brakeline.errors import BadData, ErrorBoundError
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.calibration_samples import Samples, samples_of
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.driving_kinds import driving_kinds
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.fitting import stopping_distance_of_stops
from brakeline.safety.model.model_config import FREE, ONE_STEP, RESIDUAL, ModelConfig
from brakeline.safety.model.model_set import ModelSet, extra_coordinates
from brakeline.safety.model.one_step import features_for
from brakeline.safety.model.one_step_regression import PENALTIES, Candidate, Regression
from brakeline.safety.model.set_factors import SetFactors
from brakeline.safety.model.set_shape import (
    RARE,
    Shape,
    least_half_widths,
    plans_from,
    shape_with_chords,
    shares,
    spread_features,
    stop_from_full_speed,
    typical_plans,
)

Progress = Callable[[float], None]  # called with the share of the work that is done
TRIED, CHOSEN, SCORED = 0.4, 0.8, 0.95  # shares of the work that are done after each part

DEGREES, LAGS = (1, 2, 3, 4), (0, 1)
MOST_FEATURES, FEWEST_PERIODS_A_FEATURE = 600, 5  # to select from
GOOD, MOST_GOOD = 1.25, 4  # of candidates up to this factor above the least error, the best: their sets are compared
SIMPLER = 1.03  # a simpler candidate wins if its sets are at most this factor wider
WEIGHTS = (1.0, 3.0, 10.0, 30.0)  # of the leverage
MOST_TO_CHOOSE = 10_000  # windows by which candidates are compared
PLANS_EVERY = 4  # from every fourth of these windows, plans whose sets are compared
FEWEST_ENDS = 20  # windows that end in a stop, to fit how the way after it depends on the driving before
ALL_DIVERGE = "every predictor of one period leads absurdly far away over a plan: record more driving"
QUANTILE = 0.99  # of the out-of-fold errors, by which candidates are compared


@dataclass(frozen=True)
class Choice:
    """A candidate, and how its sets grow.

    Attributes:
        candidate: the candidate.
        weight: of the leverage.
        level: number of leading `spread_features` without a slope: 0, or all measured speeds.
        width [m]: geometric mean of the half-widths of calibrated last sets, out of fold: of plans, and of a stop from
            full speed.
        full (1, nz): regressors of a stop from full speed.
    """

    candidate: Candidate
    weight: float
    level: int
    width: float
    full: Array


def unheard(share: float) -> None:
    """Ignore the progress."""


def choose(
    robot: Robot, s: Samples, outside: float = RARE, progress: Progress = unheard
) -> tuple[Choice, list[Candidate], Regression]:
    """Choose features, fit, and how the sets grow: of those with the least out-of-fold errors, the narrowest sets.

    Returns:
        The choice, all candidates from the least out-of-fold error to the largest, and the regression of the choice.
    """
    candidates: list[tuple[Candidate, Regression]] = []
    some = np.linspace(0, len(s.z) - 1, min(len(s.z), MOST_TO_CHOOSE)).astype(int)
    few_windows = replace(s, z=s.z[some], after=s.after[some], fold=s.fold[some])
    families = [*product(DEGREES, LAGS)]
    for number, (degree, lags) in enumerate(families):
        progress(TRIED * number / len(families))
        features = features_for(robot, s.v, degree, lags)
        if degree > 1 and len(features.terms) > min(MOST_FEATURES, len(s.v) / FEWEST_PERIODS_A_FEATURE):
            continue
        regression = Regression(robot, features, s)
        for penalty, instruments in product(PENALTIES, (False, True)):
            candidate = Candidate(degree, lags, penalty, instruments)
            off = _distances(robot, regression.out_of_fold(candidate, few_windows))
            with np.errstate(invalid="ignore"):
                error = float(np.quantile(off, QUANTILE))
            count = len(regression.fit(candidate).features.terms)
            candidates.append((replace(candidate, error=error, features=count), regression))
    candidates = sorted((pair for pair in candidates if np.isfinite(pair[0].error)), key=lambda pair: pair[0].error)
    good = _good_candidates(candidates, few_windows.z)
    choices = []
    for number, (candidate, regression) in enumerate(good):
        progress(TRIED + (CHOSEN - TRIED) * number / len(good))
        choices.append((_growth(robot, s, regression, candidate, outside), regression))
    choice, regression = _simple(choices, s.z)
    return choice, [c for c, _ in candidates], regression


def _simple(choices: list[tuple[Choice, Regression]], z: Array) -> tuple[Choice, Regression]:
    """Return the simplest of the choices with narrow sets that diverges in none of all windows z.

    Raises:
        BadData: all of them diverge.
    """
    while choices:
        least = min(choice.width for choice, _ in choices)
        narrow = [pair for pair in choices if pair[0].width <= SIMPLER * least]
        choice, regression = min(narrow, key=lambda pair: (pair[0].candidate.features, pair[0].width))
        if len(z) <= MOST_TO_CHOOSE or not regression.diverges(choice.candidate, z):
            return choice, regression
        choices = [pair for pair in choices if pair[0] is not choice]
    raise BadData(ALL_DIVERGE)


def _good_candidates(candidates: list[tuple[Candidate, Regression]], z: Array) -> list[tuple[Candidate, Regression]]:
    """Return the candidates whose sets are compared, from the least out-of-fold error on. None diverges in windows z.

    Raises:
        BadData: all of them diverge.
    """
    good: list[tuple[Candidate, Regression]] = []
    for candidate, regression in candidates:
        if len(good) == MOST_GOOD or (good and candidate.error > GOOD * good[0][0].error):
            break
        if not regression.diverges(candidate, z):
            good.append((candidate, regression))
    if not good:
        raise BadData(ALL_DIVERGE)
    return good


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
        chosen, candidates: the choice, and all candidates in the order of their out-of-fold errors.
        factor: factor on the final shape of positions and chord deviations, from the out-of-fold scores.
        scores (T,): how much of its sets every window used; above 1, a part of the window is outside.
        first_scores (T,): the same for the predicted state after one period alone.
        samples: the recorded driving.
        smallest_singular, condition: of the chosen features, each scaled to unit norm.
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
        raise ErrorBoundError("mode one-step does not support robots that stop by feedback: use mode direct")
    s = samples_of(data.joined())
    choice, candidates, regression = choose(robot, s, model_config.outside, progress)
    chosen, full = choice.candidate, choice.full
    scores, positions, others = window_scores(robot, _shares_used(robot, s, regression, choice, progress))
    kinds = driving_kinds(robot, s.z, s.start)
    joint_space = not robot.position_dim  # the limited coordinates are scored with the plan
    factors = SetFactors.of(scores, others, kinds, model_config.outside, same=joint_space)
    one_step = replace(regression.fit(chosen, weight=choice.weight), start=factors.start)
    predicted, stretch = one_step.rollouts_with_stretch(robot, s.z)
    errors = (s.after - predicted) / stretch[..., None]
    least = least_half_widths(robot, s.after)
    shape = shape_with_chords(robot, s.z, errors, s.chords, full, choice.level, least)
    n, N = s.after.shape[2], robot.horizon
    first, later, of_chords = scales(robot, factors, n)
    steps = tuple(shape.bound(robot, k, slice(n), first if k == 1 else later) for k in range(1, N + 1))
    chords = [shape.bound(robot, k, slice(n, n + 1), of_chords) for k in range(1, N + 1)]
    measured = len(robot.regressor)
    known = np.hstack([s.v[:, :measured], s.v[:, measured + robot.action_dim :]])  # without the period's own input
    model = ModelSet(
        robot,
        replace(model_config, mode=ONE_STEP, windows=FREE, certificate=RESIDUAL),
        steps,
        _stacked(chords),
        _stopping_distance(data, s, full, model_config),
        np.stack([known.min(0), known.max(0)]),
        np.eye(s.z.shape[1]),
        data.about | {"data": data.digest(), "periods": str(data.periods)},
        one_step=one_step,
    )
    used, used_first = (factors.shares(part, others, kinds) for part in (scores, positions))
    largest = float(factors.plan.max())
    return model, Calibration(chosen, tuple(candidates), largest, used, used_first, s, *regression.quality(one_step))


def _stacked(bounds: list[ErrorBound]) -> ErrorBound:
    """Return bounds of one coordinate each, with the same W, as one bound."""
    C, M, kappa = (np.vstack([getattr(one, name) for one in bounds]) for name in ("C", "M", "kappa"))
    return ErrorBound(C, bounds[0].W, M, kappa, np.concatenate([one.w for one in bounds]), np.eye(len(bounds)))


def _stopping_distance(data: Dataset, s: Samples, full: Array, model_config: ModelConfig) -> ErrorBound:
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
        z = s.z[ended]
        plans = typical_plans(data.robot, z, full)
        shape = Shape.around(spread_features(data.robot, z), ways_on, plans, model_config.inflation)
    return shape.bound(data.robot, data.robot.horizon, slice(1), np.ones(1))


def _growth(robot: Robot, s: Samples, regression: Regression, candidate: Candidate, outside: float) -> Choice:
    """Choose the weight of the leverage, and whether half-widths grow with the speeds, for the narrowest sets of plans.

    What counts are the last sets, as the geometric mean of plans and of a stop from full speed. Of several nearly as
    narrow, take the largest weight. Slopes on the speeds must be worth it.
    Without the leverage, one factor widens all sets because some windows at the edge of the data are predicted badly,
    and sets outside of the data are as narrow as within. Minutes of driving may hold few errors at a large speed that
    the inputs do not announce, such as the sway of a boat: then a slope on that speed is mostly noise.
    """
    some = np.linspace(0, len(s.z) - 1, min(len(s.z), MOST_TO_CHOOSE)).astype(int)
    used = [*range(robot.position_dim)] or [*extra_coordinates(robot)]
    z, after, fold = s.z[some], s.after[some, -1:][..., used], s.fold[some]
    plans, full = plans_from(robot, z[::PLANS_EVERY]), stop_from_full_speed(robot, z, regression.fit(candidate))
    spread, *of_plans = (spread_features(robot, one, last=True) for one in (z, plans, full))
    typical = typical_plans(robot, z, full, last=True)
    pairs = [*product(WEIGHTS, (0, len(robot.regressor)))]
    scores, logs = np.zeros((len(pairs), len(z))), np.zeros(len(pairs))
    for i in regression.folds:
        one_step, held = regression.fit(candidate, i, weight=1.0), fold == i
        outputs, stretch = one_step.rollouts_with_last_stretch(robot, z)
        off = after - outputs[:, -1:][..., used]
        stretches = stretch, *(one_step.last_stretches(robot, one) for one in (plans, full))
        leverages, *theirs = (one[:, None] ** 2 - 1.0 for one in stretches)
        for p, (weight, level) in enumerate(pairs):
            errors = off / np.sqrt(1.0 + weight * leverages)[..., None]
            shape = Shape.around(spread[:, ~held], errors[~held], typical, level=level, outside=RARE)
            scores[p, held] = shape.scores(spread[:, held], errors[held])
            for some_plans, leverage in zip(of_plans, theirs, strict=True):
                wide = shape.widths(some_plans)[:, 0] * np.sqrt(1.0 + weight * leverage)
                logs[p] += np.log(wide).mean() / (2 * len(regression.folds))
    with np.errstate(invalid="ignore"):
        widths = np.maximum(np.quantile(scores, 1.0 - outside, axis=1), 1.0) * np.exp(logs)
    width_of = dict(zip(pairs, np.where(np.isnan(widths), np.inf, widths), strict=True))  # a rollout may diverge
    least = {level: min(width for pair, width in width_of.items() if pair[1] == level) for _, level in pairs}
    level = max(level for level, width in least.items() if level == 0 or width <= SIMPLER * least[0])
    weight = max(w for w in WEIGHTS if width_of[w, level] <= SIMPLER * least[level])
    return Choice(candidate, weight, level, float(width_of[weight, level]), full)


def _shares_used(robot: Robot, s: Samples, regression: Regression, choice: Choice, progress: Progress) -> Array:
    """Return how much of its sets each window used (T, N, n' + 1), from the folds that it is not in.

    The last coordinate is the chord deviation.
    """
    used, least = np.zeros((*s.after.shape[:2], s.after.shape[2] + 1)), least_half_widths(robot, s.after)
    for i in regression.folds:
        progress(CHOSEN + (SCORED - CHOSEN) * i / len(regression.folds))
        held = s.fold == i
        one_step = regression.fit(choice.candidate, i, choice.weight)
        predicted, stretch = one_step.rollouts_with_stretch(robot, s.z)
        errors = (s.after - predicted) / stretch[..., None]
        z, chords, rest = s.z[~held], s.chords[~held], errors[~held]
        shape = shape_with_chords(robot, z, rest, chords, choice.full, choice.level, least)
        used[held] = window_shares(errors[held], s.chords[held], shape.widths(spread_features(robot, s.z[held])))
    return used


def window_shares(errors: Array, chords: Array, widths: Array) -> Array:
    """Return the shares (T, N, n' + 1) of half-widths (T, N, n' + 1) that errors (T, N, n') and chords (T, N) used."""
    return shares(np.concatenate([np.abs(errors), chords[..., None]], axis=2), widths)


def window_scores(robot: Robot, used: Array) -> tuple[Array, Array, Array]:
    """Return the scores of windows that used these shares (T, N, n' + 1) of their sets.

    Returns:
        The largest share (G, T) of each position, each coordinate that a limit needs, and the chord deviations; the
        shares (d, T) of the positions after one period; the largest one (T,) of the other coordinates after one period.
    """
    d = robot.position_dim
    return used[..., _of_plans(robot)].max(1).T, used[:, 0, :d].T, used[:, 0, d:-1].max(1, initial=0.0)


def scales(robot: Robot, factors: SetFactors, count: int) -> tuple[Array, Array, Array]:
    """Return the factors on the sets of `count` predicted coordinates.

    Coordinates that no plan needs have the largest factor of those that it needs.

    Returns:
        Those after one period (count,), those after each further period (count,), and that on chord deviations (1,).
    """
    later = np.full(count + 1, factors.plan.max())
    later[_of_plans(robot)] = factors.plan
    first = np.where(np.arange(count) < robot.position_dim, later[:-1], factors.first)
    return first, later[:-1], later[-1:]


def _of_plans(robot: Robot) -> list[int]:
    """Return the places of the coordinates that a plan needs after every period, and of the chord deviations."""
    return [*range(robot.position_dim), *extra_coordinates(robot), -1]
