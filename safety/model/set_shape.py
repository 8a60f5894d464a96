"""The half-widths of a rollout's sets as a function of the driving, up to a factor (docs/method.md §13)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.envelopes import Envelopes
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.one_step import OneStep
from brakeline.safety.model.windows import plan_regressor_map

# Weight of a stop from full speed among the plans for which a shape is tightest: of positions, which decide about
# obstacles, and of the other coordinates, which must hold whatever the inputs do within a period.
FULL_SPEED, FULL_SPEED_OTHERS = 0.3, 0.1
SETTLED = 3  # plans' lengths after which a robot with constant inputs has settled
RARE = 0.001  # share of the windows that do not decide about the shape
MOST_FOR_SHAPE = 20_000  # windows
MOST_TYPICAL = 5_000  # windows from whose starts the typical plans begin: more hardly change their mean
CHORD_INFLATION = 1.15  # on the chord deviations' shape, because calibration scales all parts by one factor
RESOLUTION = 1e-5  # of a coordinate's largest change, to which sets hold: a learner's actions have single precision
LEAST_CHORD = 0.2  # of the position's half-width: a chord deviation of a millimetre must not widen all sets


def spread_features(robot: Robot, z: Array, last: bool = False) -> Array:
    """Return the features (N, T, q) with which half-widths grow in each period, for regressors z (T, r + m + N·m).

    These are the speeds, the input in force, and the means of the inputs so far and of their jumps, each without its
    sign: with a slope for each input, minutes of driving would not determine a half-width. A jump is the first change,
    or the difference of a change from the one before: a steady ramp, such as braking, does not jump.
    last: of the last period alone (1, T, q).
    """
    known, m = robot.regressor_dim, robot.action_dim
    inputs = np.moveaxis(z[:, known - m :].reshape(len(z), -1, m), 1, 0)  # from the input in force on
    changes = np.diff(inputs, axis=0)
    driven = np.concatenate([inputs[1:], np.diff(changes, axis=0, prepend=0.0)], axis=2)
    driven = np.abs(driven, out=driven)
    if last:
        means = driven.sum(0, keepdims=True) / len(driven)
    else:
        means = driven.cumsum(0)
        means /= np.arange(1.0, len(driven) + 1.0)[:, None, None]
    speeds = np.broadcast_to(np.abs(z[:, :known]), (len(means), len(z), known))
    return np.concatenate([speeds, means], axis=2)


def plans_from(robot: Robot, z: Array) -> Array:
    """Return the regressors of plans from recorded starts: with the recorded first input, and braking at once."""
    known, m = robot.regressor_dim, robot.action_dim
    firsts = z[:, known : known + m], np.broadcast_to(robot.zero_input(), (len(z), m))
    plans = [np.hstack([z[:, :known], np.tile(first, robot.free_steps)]) for first in firsts]
    return np.asarray(np.vstack(plans) @ plan_regressor_map(robot).T)


def stop_from_full_speed(robot: Robot, z: Array, one_step: OneStep) -> Array:
    """Return the regressors (1, nz) of a plan from all inputs at their upper bounds.

    Speeds that follow no input, such as a boat's sway, are those at which the predictor settles with these inputs,
    within what was recorded in z (T, nz), as absolute values: a boat's sway is small, but not in fast turns. A
    coordinate that never was zero, such as a battery's voltage, keeps its sign.
    """
    high, measured = np.asarray(robot.high()), list(robot.regressor)
    follows, known = np.isin(measured, robot.follows), len(measured)
    least, most = z[:, :known].min(0), z[:, :known].max(0)
    one_sided, largest = (least > 0.0) | (most < 0.0), np.maximum(-least, most)
    low, top = np.where(one_sided, least, -largest), np.where(one_sided, most, largest)
    start = np.where(follows, robot.state_at_inputs(high)[measured], np.clip(0.0, least, most))
    speeds = start
    for _ in range(SETTLED):
        window = np.concatenate([speeds, np.tile(high, robot.horizon + 1)])
        after = one_step.rollouts(robot, window[None])[0, -1, measured]
        speeds = np.where(follows | ~np.isfinite(after), start, np.clip(after, low, top))
    plan = np.concatenate(
        [np.where(follows | one_sided, speeds, np.abs(speeds)), high, np.tile(high, robot.free_steps)]
    )
    return np.asarray(plan[None] @ plan_regressor_map(robot).T)


def typical_plans(robot: Robot, z: Array, full: Array, last: bool = False) -> Array:
    """Return the `spread_features` (N, P, q) of plans from the starts of windows z (T, nz), and of a fast stop.

    Recorded driving holds large inputs until the end of a window, while plans brake. The stop from full speed, with the
    regressors `full` (1, nz), is the last one, with a weight of its own: such stops are rare, and need the most room.
    """
    starts = z[:: math.ceil(len(z) / MOST_TYPICAL)]
    return spread_features(robot, np.vstack([plans_from(robot, starts), full]), last)


@dataclass(frozen=True)
class Shape:
    """Half-widths of the predicted coordinates after each period, up to a factor: slopes · `spread_features` + w.

    Attributes:
        slopes (N, n', q), w (N, n'): n' coordinates.
    """

    slopes: Array
    w: Array

    def widths(self, spread: Array) -> Array:
        """Return half-widths (T, N, n') for `spread_features` (N, T, q)."""
        grown = spread @ np.swapaxes(self.slopes, 1, 2)
        return np.ascontiguousarray(np.moveaxis(grown, 0, 1) + self.w)

    def scores(self, spread: Array, errors: Array) -> Array:
        """Return the largest ratio (T,) of the errors (T, N, n') to the half-widths for `spread` (N, T, q)."""
        return np.asarray(shares(np.abs(errors), self.widths(spread)).max((1, 2)))

    @staticmethod
    def around(
        spread: Array,
        errors: Array,
        plans: Array,
        inflation: float = 1.0,
        level: int = 0,
        outside: float = 0.0,
        others: slice = slice(0),
    ) -> Shape:
        """Return the shape that holds the errors (T, N, n') and is tightest for plans as the filter has (`_tightest`).

        Args:
            spread (N, T, q): `spread_features` of the windows of the errors.
            errors (T, N, n'): errors to hold.
            plans (N, P, q): features of the plans for which it is tightest: `typical_plans`.
            inflation: factor on the shape.
            level: number of features, from the first on, with which half-widths do not grow.
            outside: share of the windows that the shape need not hold: those that most exceed the others' trend. Their
                errors would decide about all sets, and such a share of windows may leave its sets anyway.
            others: the coordinates that are no positions.
        """
        shape = Shape._holding(spread, errors, plans, inflation, level, others)
        if not (dropped := int(outside * len(errors))):
            return shape
        held = np.argsort(shape.scores(spread, errors))[:-dropped]
        return Shape._holding(spread[:, held], errors[held], plans, inflation, level, others)

    @staticmethod
    def _holding(spread: Array, errors: Array, plans: Array, inflation: float, level: int, others: slice) -> Shape:
        fast = np.full(errors.shape[2], FULL_SPEED)
        fast[others] = FULL_SPEED_OTHERS
        share = np.tile(((1.0 - fast) / (plans.shape[1] - 1))[:, None], plans.shape[1])
        share[:, -1] = fast
        coordinates = zip(spread[..., level:], np.moveaxis(np.abs(errors), 1, 0), plans[..., level:], strict=True)
        fits = [_tightest(features, values, inflation, some, share) for features, values, some in coordinates]
        grown, w = np.array([one[0] for one in fits]), np.array([one[1] for one in fits])
        return Shape(np.concatenate([np.zeros((*w.shape, level)), grown], axis=2), w)

    def bound(self, robot: Robot, k: int, coordinates: slice, factor: Array) -> ErrorBound:
        """Return the error bound of some coordinates after k periods, each times its factor; without a predictor.

        The rows of W are the jumps of the inputs (`spread_features`).
        """
        known, m, N = robot.regressor_dim, robot.action_dim, robot.horizon
        nz = known + N * m
        changes = np.eye(N * m, nz, known) - np.eye(N * m, nz, known - m)
        jumps = changes - np.vstack([np.zeros((m, nz)), changes[:-m]])
        slopes, w = factor[:, None] * self.slopes[k - 1, coordinates], factor * self.w[k - 1, coordinates]
        kappa, M = np.zeros((len(w), nz)), np.zeros((len(w), N * m))
        kappa[:, :known] = slopes[:, :known]
        kappa[:, known : known + k * m] = np.tile(slopes[:, known : known + m] / k, k)
        M[:, : k * m] = np.tile(slopes[:, known + m :] / k, k)
        return ErrorBound(np.zeros_like(kappa), jumps, M, kappa, w, np.eye(len(w)))


def _tightest(features: Array, values: Array, inflation: float, plans: Array, share: Array) -> tuple[Array, Array]:
    """Return slopes (n', q) and w (n',) that hold the values (T, n') and are tightest for the plans' features (P, q).

    Each coordinate weighs the plans by its share (n', P).

    Two linear programs: the first minimises the mean of the half-widths, in which fast plans weigh most; the second the
    mean of their ratios to those of the first. So a slow plan counts as much: close to obstacles, a robot is slow.
    """
    envelopes = Envelopes(features, values)
    slopes, w = envelopes.tightest(share @ plans, inflation)
    widths = plans @ slopes.T + w
    weights = share.T / np.maximum(widths, 1e-9 * widths.max(0, keepdims=True) + 1e-300)
    return envelopes.tightest((weights / weights.sum(0)).T @ plans, inflation)


def shares(errors: Array, widths: Array) -> Array:
    """Return the ratio of errors to half-widths: 0 without an error, infinite where only the half-width is 0.

    It is also infinite where an error or a half-width is no number: then nothing says that the set holds the error.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(errors <= 0.0, 0.0, errors / widths)
    return np.where(np.isnan(ratios) | np.isnan(widths), np.inf, ratios)


def least_half_widths(robot: Robot, after: Array) -> Array:
    """Return the least half-widths (N, n') of sets whose recorded outputs are `after` (T, N, n')."""
    largest = np.abs(after).max(0)
    d = robot.position_dim
    largest[:, :d] = largest[:, :d].max(1, keepdims=True, initial=0.0)  # a path that hardly curves may lie askew
    return np.asarray(RESOLUTION * largest)


def shape_with_chords(
    robot: Robot, z: Array, errors: Array, chords: Array, full: Array, level: int, least: Array
) -> Shape:
    """Return the shape of all errors but rare ones, and of the chord deviations as a further coordinate.

    least (N, n'): the least half-widths of the errors (`least_half_widths`).
    """
    some = np.linspace(0, len(z) - 1, min(len(z), MOST_FOR_SHAPE)).astype(int)
    both = np.concatenate([errors[some], chords[some, :, None]], axis=2)
    plans = typical_plans(robot, z[some], full)
    others = slice(robot.position_dim, robot.state_dim)
    shape = Shape.around(spread_features(robot, z[some]), both, plans, level=level, outside=RARE, others=others)
    shape.slopes[:, -1] *= CHORD_INFLATION
    shape.w[:, :-1] = np.maximum(shape.w[:, :-1], least)
    if robot.position_dim:
        chord = LEAST_CHORD * shape.w[-1, : robot.position_dim].mean()
    else:
        chord = LEAST_CHORD * float((np.abs(robot.limit_weights) @ shape.w[-1, :-1] / robot.limit_scales).mean())
    shape.w[:, -1] = np.maximum(CHORD_INFLATION * shape.w[:, -1], chord)
    return shape
