"""A model set from recorded data (docs/method.md §1, §2): predictors, their bounds, bulges and the stop latch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import BadData, Dataset
from brakeline.safety.model.error_bounds import (
    MATRIX_ZONOTOPE,
    RESIDUAL,
    SET_MEMBERSHIP,
    ErrorBound,
    ErrorBoundError,
    envelope,
    least_squares,
    matrix_zonotope,
    residual,
    set_membership,
    whitening,
)
from brakeline.safety.model.model_set import DIRECT, RECURSION, ModelConfig, ModelSet
from brakeline.safety.model.turning_in_place import InPlace, inside, over_plan, standing_limits, turning
from brakeline.safety.model.windows import (
    FREE,
    PLAN,
    Windows,
    check_regressors,
    periods_until_standing,
    predicted_outputs,
    resting_periods_at_end,
    stopping_distances,
    windows,
)

Array = NDArray[np.float64]

FEWEST_STOPS = 5  # that a bound of the way after a stop is worth anything from
FEWEST_IN_PLACE = 100  # windows in place: fewer regressors play a part in them than in others
MOST_ATOMS = 120_000  # of a matrix zonotope, over the horizon: the exact check looks at every one


def fit_model_set(data: Dataset, model_config: ModelConfig) -> ModelSet:
    """A model set from two parts of the data: one fits C, the other bounds what is left (held-out data: certify).

    Raises:
        BadData: a check failed; CertificateError: the data do not support the certificate.
    """
    robot, kind = data.robot, model_config.windows
    if model_config.mode == RECURSION and any(disc.arm for disc in robot.body):
        raise ErrorBoundError("the recursion knows no body of discs beside the regressed position: use mode direct")
    if kind == FREE and robot.feedback:
        raise ErrorBoundError("what a feedback makes of the state has to be recorded: drive plans, not freely")
    fit, bound = data.split((0.5, 0.5))
    steps, chord_deviations = [], []
    horizon = robot.horizon
    for k in range(1, horizon + 1):
        seen, rest = windows(fit, k, kind), windows(bound, k, kind)
        columns = _columns(robot, k, kind)
        for part in (seen, rest):
            check_regressors(part.z[:, columns], f"windows of {k} periods", model_config.fewest)
        every = windows(data, k, kind)  # no predictor is fitted to bulges: both parts may bound them
        chord_deviations.append(envelope(np.abs(every.z), every.chord_deviation, model_config.inflation))
        if model_config.mode == DIRECT:
            after, later = predicted_outputs(robot, seen.y), predicted_outputs(robot, rest.y)
            steps.append(_certificate(seen.z, after, rest.z, later, model_config, columns, MOST_ATOMS // horizon))
        else:
            steps.append(_recursive_step(robot, windows(fit, 1), windows(bound, 1), k - 1, model_config))
    whole = windows(data, horizon, kind)
    nz = whole.z.shape[1]
    stopping_distance = (
        _latch_of_plans(whole, model_config) if kind == PLAN else (np.zeros(nz), _latch_of_stops(data, model_config))
    )
    known = windows(data, 1).z[:, : robot.regressor_dim]
    domain = np.stack([known.min(0), known.max(0)])
    about = data.about | {"data": data.digest(), "periods": str(data.periods)}
    return ModelSet(
        robot,
        model_config,
        tuple(steps),
        _scalar(chord_deviations, nz),
        _scalar([stopping_distance], nz),
        domain,
        whitening(whole.z),
        about,
        stands=periods_until_standing(whole, data, kind),
        in_place=_in_place(fit, bound, model_config),
    )


def _in_place(fit: Dataset, bound: Dataset, model_config: ModelConfig) -> InPlace | None:
    """The predictors for plans in place, from all windows in place; None where the data do not support them (too few
    such windows, or no varied turning among them) or the robot has no such plans."""
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
            for each in (z, z_bound):
                check_regressors(
                    each[:, turns], f"windows of {k} periods in place", min(model_config.fewest, FEWEST_IN_PLACE)
                )
            steps.append(_certificate(z, y, z_bound, y_bound, model_config, turns, MOST_ATOMS // robot.horizon))
        except (BadData, ErrorBoundError):
            return None
    return InPlace(tuple(steps), np.where(free, _range(robot, np.vstack([z, z_bound])), limits))


def _range(robot: Robot, z: Array) -> Array:
    """(2, r + m): the least and the largest [x_0; input in force] and input of the plans among regressors z (T, nz).

    A speed that follows an input may be measured beyond what was recorded of it by its error.
    """
    known, m = robot.regressor_dim, robot.action_dim
    inputs = z[:, known - m :].reshape(-1, m)
    found = np.stack([np.append(f(z[:, :known], axis=0), f(inputs, axis=0)) for f in (np.min, np.max)])
    found[:, known - m : known] = found[:, known:]
    for i, index in enumerate(robot.follows):
        if index in robot.regressor:
            at, error = robot.regressor.index(index), robot.measurement_bound[index]
            found[0, at] = min(found[0, at], found[0, known + i] - error)
            found[1, at] = max(found[1, at], found[1, known + i] + error)
    return found


def _latch_of_plans(whole: Windows, model_config: ModelConfig) -> tuple[Array, float]:
    """The way still travelled after a plan's last input, bounded by what the plan was."""
    still = ~np.isnan(whole.stopping_distance)
    if not still.any():
        raise BadData("no plan's stop was recorded: let the robot stand after braking")
    return envelope(np.abs(whole.z[still]), whole.stopping_distance[still], model_config.inflation)


def _latch_of_stops(data: Dataset, model_config: ModelConfig) -> float:
    """The same whatever the plan was: from wherever inputs had been those of a stop for as long as they are at a
    plan's end.

    Raises:
        BadData: that occurs too seldom; the message says what to drive.
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
    """Which coordinates of z can matter after k periods: later chosen inputs can't."""
    chosen = robot.free_steps if kind == PLAN else robot.horizon
    used = np.ones(robot.regressor_dim + chosen * robot.action_dim, dtype=bool)
    used[robot.regressor_dim + min(k, chosen) * robot.action_dim :] = False
    return used


def _scalar(bounds: list[tuple[Array, float]], nz: int) -> ErrorBound:
    """Bounds of lengths as a certificate: nothing but κ and w."""
    n = len(bounds)
    kappa, w = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    return ErrorBound(np.zeros((n, nz)), np.zeros((0, nz)), np.zeros((n, 0)), kappa, w, np.eye(n))


def _certificate(
    z: Array,
    y: Array,
    z_bound: Array,
    y_bound: Array,
    model_config: ModelConfig,
    columns: NDArray[np.bool_],
    most_atoms: int,
) -> ErrorBound:
    """The recipe's certificate: the noise of all three is the residual's envelope, they differ in trusting C.

    A matrix zonotope has an atom a sample and more samples do not shrink it: it takes no more than `most_atoms`,
    evenly over the data.
    """
    trusted = residual(z_bound, y_bound, least_squares(z, y, columns), model_config.inflation)
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
    """Period k of the recursion: z_k = [heading, ...; u_prev; u] from one-period windows turned by a random offset.

    After k periods the robot may have turned by k ω_max dt against the frame of now, as measured a bit more; without
    offsets the heading would be zero in every window and the data would say nothing about it.
    """
    rng = np.random.default_rng((model_config.seed, k))
    turned = [_turned(robot, w, k, rng) for w in (fit, bound)]
    columns = np.abs(turned[0][0]).max(0) > 0.0
    return _certificate(*turned[0], *turned[1], model_config, columns, MOST_ATOMS // robot.horizon)


def _turned(robot: Robot, w: Windows, k: int, rng: np.random.Generator) -> tuple[Array, Array]:
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
