"""Fit a model set to recorded data: predictors and all its bounds (docs/method.md §1, §2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadData, ErrorBoundError
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.envelopes import Envelopes
from brakeline.safety.model.error_bounds import (
    ErrorBound,
    least_squares,
    matrix_zonotope,
    residual,
    set_membership,
    whitening,
)
from brakeline.safety.model.model_config import (
    DIRECT,
    FREE,
    MATRIX_ZONOTOPE,
    MODES,
    PLAN,
    RECURSION,
    RESIDUAL,
    SET_MEMBERSHIP,
    ModelConfig,
)
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.set_shape import least_half_widths
from brakeline.safety.model.turning_in_place import InPlace, inside, over_plan, standing_limits, turning
from brakeline.safety.model.windows import (
    Windows,
    check_regressors,
    periods_until_standing,
    predicted_outputs,
    recorded_domain,
    resting_periods_at_end,
    stopping_distances,
    windows,
)

FEWEST_STOPS = 5  # with fewer stops, the bound of the stopping distance would mean little
FEWEST_IN_PLACE = 100  # windows in place; they have fewer regressors than others
MOST_ATOMS = 120_000  # rows of W of a matrix zonotope, over the horizon: the exact check evaluates each


def fit_model_set(data: Dataset, model_config: ModelConfig) -> ModelSet:
    """Fit a model set: one half of the trajectories fits C, the other half bounds the error.

    >>> from brakeline import Dataset
    >>> fit_model_set(Dataset.load(RECORDING), ModelConfig())  # a file of `brakeline collect` or `brakeline import`
    ModelSet('ground', residual, direct, version '...', no bound stated)

    Raises:
        BadData: a check of the data failed.
        ErrorBoundError: the data do not support this kind of error bound, or the mode is neither direct nor recursion.
    """
    robot, kind = data.robot, model_config.windows
    _check_mode(robot, model_config)
    fit, bound = data.split((0.5, 0.5))
    steps, chord_deviations = [], []
    horizon = robot.horizon
    for k in range(1, horizon + 1):
        seen, rest = windows(fit, k, kind), windows(bound, k, kind)
        columns = _columns(robot, k, kind)
        for part in (seen, rest):
            check_regressors(part.z[:, columns], f"windows of {k} periods", model_config.fewest)
        every = windows(data, k, kind)  # chord deviations have no predictor, so both halves bound them
        chord_deviations.append(_length_envelope(every.z, every.chord_deviation, model_config.inflation))
        if model_config.mode == DIRECT:
            after, later = predicted_outputs(robot, seen.y), predicted_outputs(robot, rest.y)
            steps.append(_error_bound(robot, seen.z, after, rest.z, later, model_config, columns))
        else:
            steps.append(_recursive_step(robot, windows(fit, 1), windows(bound, 1), k - 1, model_config))
    whole = windows(data, horizon, kind)
    nz = whole.z.shape[1]
    if kind == PLAN:
        stopping_distance = _stopping_distance_of_plans(whole, model_config)
    else:
        stopping_distance = np.zeros(nz), stopping_distance_of_stops(data, model_config)
    about = data.about | {"data": data.digest(), "periods": str(data.periods)}
    return ModelSet(
        robot,
        model_config,
        tuple(steps),
        _scalar(chord_deviations, nz),
        _scalar([stopping_distance], nz),
        recorded_domain(data),
        whitening(whole.z),
        about,
        stands=periods_until_standing(whole, data, kind),
        in_place=_in_place(fit, bound, model_config),
    )


def _check_mode(robot: Robot, model_config: ModelConfig) -> None:
    """Raise ErrorBoundError if no model set of this mode and these windows predicts the robot."""
    if model_config.mode not in MODES:
        mode = model_config.mode
        raise ErrorBoundError(f"fit_model_set fits no mode {mode}: name direct or recursion (certify: or one-step)")
    if not robot.position_dim:
        raise ErrorBoundError(f"{robot.name} has no position, so this mode predicts nothing of it: use mode one-step")
    if model_config.mode == RECURSION and any(disc.arm for disc in robot.body):
        raise ErrorBoundError("the recursion knows no body of discs beside the regressed position: use mode direct")
    if model_config.windows == FREE and robot.feedback:
        raise ErrorBoundError("what a feedback makes of the state has to be recorded: drive plans, not freely")


def _in_place(fit: Dataset, bound: Dataset, model_config: ModelConfig) -> InPlace | None:
    """Return predictors for plans in place, fitted to all windows in place.

    None if the data do not support them (too few windows, no varied turning), or if the robot has no such plans.
    """
    robot = fit.robot
    limits = standing_limits(robot)
    if limits is None or model_config.mode != DIRECT:
        return None
    steps, known, free = [], robot.regressor_dim, turning(robot)
    for k in range(1, robot.horizon + 1):
        columns = _columns(robot, k, FREE)
        bounds = over_plan(limits, len(columns), known)[:, columns]
        turns = over_plan(free[None].astype(float), len(columns), known)[0].astype(bool) & columns
        both = windows(fit, k, FREE), windows(bound, k, FREE)
        parts = [part.take(inside(part.z[:, columns], bounds)) for part in both]
        z, z_bound = (np.where(turns, part.z, 0.0) for part in parts)
        y, y_bound = (predicted_outputs(robot, part.y) for part in parts)
        try:
            for regressors in (z, z_bound):
                check_regressors(
                    regressors[:, turns], f"windows of {k} periods in place", min(model_config.fewest, FEWEST_IN_PLACE)
                )
            steps.append(_error_bound(robot, z, y, z_bound, y_bound, model_config, turns))
        except (BadData, ErrorBoundError):
            return None
    return InPlace(tuple(steps), np.where(free, _range(robot, np.vstack([z, z_bound])), limits))


def _range(robot: Robot, z: Array) -> Array:
    """Return the range (2, r + m) of [x_0; input in force] and of the plans' inputs in regressors z (T, nz).

    A speed that follows an input may be measured outside the input's range by its measurement error.
    """
    known, m = robot.regressor_dim, robot.action_dim
    inputs = z[:, known - m :].reshape(-1, m)
    ranges = np.stack([np.append(f(z[:, :known], axis=0), f(inputs, axis=0)) for f in (np.min, np.max)])
    ranges[:, known - m : known] = ranges[:, known:]
    for i, index in enumerate(robot.follows):
        if index in robot.regressor:
            at, error = robot.regressor.index(index), robot.measurement_bound[index]
            ranges[0, at] = min(ranges[0, at], ranges[0, known + i] - error)
            ranges[1, at] = max(ranges[1, at], ranges[1, known + i] + error)
    return ranges


def _stopping_distance_of_plans(whole: Windows, model_config: ModelConfig) -> tuple[Array, float]:
    """Return the envelope (κ, w) of the stopping distance σ(z) after the last input of plan windows."""
    still = ~np.isnan(whole.stopping_distance)
    if not still.any():
        raise BadData("no plan's stop was recorded: let the robot stand after braking")
    return _length_envelope(whole.z[still], whole.stopping_distance[still], model_config.inflation)


def _length_envelope(z: Array, lengths: Array, inflation: float) -> tuple[Array, float]:
    """Return the envelope (κ, w) of lengths (T,) for regressors z (T, nz)."""
    kappa, w = Envelopes(np.abs(z), lengths[:, None]).tightest(inflation=inflation)
    return kappa[0], float(w[0])


def stopping_distance_of_stops(data: Dataset, model_config: ModelConfig) -> float:
    """Return one bound [m] of the stopping distance for all plans.

    It comes from all times at which the inputs had been those of a stop for as long as at the end of a plan.

    Raises:
        BadData: there are too few stops; the message says what to record.
    """
    robot = data.robot
    rested = resting_periods_at_end(robot)
    travels = np.concatenate([stopping_distances(robot, t, rested) for t in data.trajectories])
    if len(travels) < FEWEST_STOPS:
        raise BadData(
            f"{len(travels)} stops in the data, at least {FEWEST_STOPS} are needed: from every speed give zero input "
            f"and let the robot stand for {(rested + 2) * robot.period:.1f} s or more"
        )
    return model_config.inflation * float(travels.max())


def _columns(robot: Robot, k: int, kind: str) -> NDArray[np.bool_]:
    """Return the coordinates of z that matter after k periods; later inputs do not."""
    chosen = robot.free_steps if kind == PLAN else robot.horizon
    used = np.ones(robot.regressor_dim + chosen * robot.action_dim, dtype=bool)
    used[robot.regressor_dim + min(k, chosen) * robot.action_dim :] = False
    return used


def _scalar(bounds: list[tuple[Array, float]], nz: int) -> ErrorBound:
    """Return bounds of lengths, κ and w only, as an error bound."""
    n = len(bounds)
    kappa, w = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    return ErrorBound(np.zeros((n, nz)), np.zeros((0, nz)), np.zeros((n, 0)), kappa, w, np.eye(n))


def _error_bound(
    robot: Robot,
    z: Array,
    y: Array,
    z_bound: Array,
    y_bound: Array,
    model_config: ModelConfig,
    columns: NDArray[np.bool_],
) -> ErrorBound:
    """Return the error bound of the configured kind. The residual's envelope is the noise bound of all three kinds.

    Data without noise would give an envelope of rounding errors. So the median of its half-widths is at least that of
    `least_half_widths`.

    A matrix zonotope has one row of W for each sample, and more samples do not make it smaller. So it uses at most
    `MOST_ATOMS` samples over the horizon, spread evenly over the data.
    """
    trusted = residual(z_bound, y_bound, least_squares(z, y, columns), model_config.inflation)
    least = least_half_widths(robot, np.vstack([y, y_bound])[:, None])[0]
    missing = least - np.median(trusted.half_widths(z_bound), axis=0)
    trusted = replace(trusted, w=trusted.w + np.maximum(missing, 0.0))
    most_atoms = MOST_ATOMS // robot.horizon
    if model_config.certificate == RESIDUAL:
        return trusted
    if model_config.certificate == MATRIX_ZONOTOPE and len(z_bound) > most_atoms:
        chosen = np.linspace(0, len(z_bound) - 1, most_atoms).astype(int)
        z_bound, y_bound = z_bound[chosen], y_bound[chosen]
    z_in = z_bound[:, columns]
    sizes = (np.abs(z_bound) @ trusted.kappa.T + trusted.w).T
    kappa, w = trusted.kappa, trusted.w
    if model_config.certificate == SET_MEMBERSHIP:
        small = set_membership(z_in, y_bound, sizes, kappa[:, columns], w)
    else:
        assert model_config.certificate == MATRIX_ZONOTOPE
        small = matrix_zonotope(z_in, y_bound, np.eye(y.shape[1]), sizes, kappa[:, columns], w)
    C, W = np.zeros_like(trusted.C), np.zeros((len(small.W), len(columns)))
    C[:, columns], W[:, columns] = small.C, small.W
    return ErrorBound(C, W, small.M, kappa, w, small.generators)


def _recursive_step(robot: Robot, fit: Windows, bound: Windows, k: int, model_config: ModelConfig) -> ErrorBound:
    """Return the error bound of step k of the recursion, z_k = [heading, ...; u_{k-1}; u_k] (docs/method.md §5).

    It is fitted to one-period windows turned by a random offset of up to k times the largest turn in a period, plus
    twice the measurement error. Without offsets, the heading would be zero in all windows.
    """
    rng = np.random.default_rng((model_config.seed, k))
    turned = [_turned(robot, w, k, rng) for w in (fit, bound)]
    columns = np.abs(turned[0][0]).max(0) > 0.0
    return _error_bound(robot, *turned[0], *turned[1], model_config, columns)


def _turned(robot: Robot, w: Windows, k: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return regressors z_k and targets of one-period windows, turned by random offsets."""
    reg, m = len(robot.regressor), robot.action_dim
    values, inputs = w.z[:, :reg], w.z[:, reg : reg + 2 * m]
    y = w.y.copy()
    between = robot.state_dim - robot.position_dim - reg
    lead = np.zeros((len(y), between))
    if robot.heading is not None:
        fastest = robot.high()[-1] * robot.period * k + 2.0 * robot.measurement_bound[robot.heading]
        offset = rng.uniform(-fastest, fastest, len(y)) if k else np.zeros(len(y))
        y[:, : robot.position_dim] = rotate(y[:, : robot.position_dim], offset)
        y[:, robot.heading] += offset
        lead[:, 0] = offset
    return np.hstack([lead, values, inputs]), y
