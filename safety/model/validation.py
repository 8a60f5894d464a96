"""Validate a model set on held-out plans, at 99 % confidence (docs/method.md §12).

The resulting statement holds for the recorded distribution only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from brakeline.messaging.stated_share import CONFIDENCE as CONFIDENCE
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.reachable_tube import Tube
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.driving_kinds import driving_kinds
from brakeline.safety.model.error_causes import (
    AFTER,
    PATH,
    ViolationGroup,
    group_violations,
    position_parts,
    regimes,
    state_parts,
)
from brakeline.safety.model.model_set import DIRECT, ModelSet, extra_coordinates
from brakeline.safety.model.one_step_fitting import Calibration
from brakeline.safety.model.one_step_regression import Candidate
from brakeline.safety.model.set_shape import shares as shares_of
from brakeline.safety.model.turning_in_place import inside
from brakeline.safety.model.windows import (
    PLAN,
    RegressorQuality,
    Windows,
    check_regressors,
    non_overlapping,
    non_overlapping_starts,
    predicted_outputs,
    windows,
)

Array = NDArray[np.float64]

EPISODE = 300  # steps
HOUR = 3600.0  # s
CHUNK = 256  # windows at once, since an exact matrix zonotope has thousands of generators


@dataclass(frozen=True)
class GroupStatement:
    """What a model set states about one kind of driving (docs/method.md §14).

    Attributes:
        name: one of the names in `driving_kinds`.
        windows: number of windows of this kind, which may overlap.
        plans: number of them that do not overlap.
        violations: number of `plans` outside their tubes.
        marginal: about the largest share of new plans outside to expect.
        bound: the largest share of plans outside, at 99 % confidence.
        excess: the largest ratio of an error to its bound.
        step_violations: number of `windows` whose first step was outside.
        bound_step: the largest share of steps outside, at 99 % confidence.
    """

    name: str
    windows: int
    plans: int
    violations: int
    marginal: float
    bound: float
    excess: float
    step_violations: int
    bound_step: float


@dataclass(frozen=True)
class ValidationReport:
    """The validation of one model set on held-out plan windows (docs/method.md §12).

    The windows do not overlap, and each includes at least one recorded period after its stop. A window is a violation
    if any part of it is outside its predicted set.

    >>> from brakeline import Dataset, ModelConfig, fit_model_set
    >>> fitted, held_out = Dataset.load(RECORDING).split((0.7, 0.3))
    >>> report = validate(fit_model_set(fitted, ModelConfig()), fitted, held_out)
    >>> report.violations / report.windows < report.bound_plan
    True
    """

    certificate: str
    mode: str
    version: str
    samples: int  # plan windows that the predictors were fitted and bounded on
    rank: int
    smallest_singular: float
    condition: float
    windows: int  # held out
    violations: int  # windows with a step, chord deviation or stopping distance outside
    step_violations: int  # windows whose first step was outside, in any coordinate
    bound_step: float  # probability that a step's measured state is outside, at 99 % confidence
    bound_plan: float  # the same for any part of a plan
    bound_episode: float  # the same for any of `EPISODE` steps, from bound_step, if steps were independent
    outside_episode: float  # bound on the mean number of steps outside in `EPISODE` steps, from bound_step
    outside_hour: float  # the same for an hour of driving
    half_width_rest: float  # in `unit`, for a full stop, largest axis, without the position noise of the estimate
    half_width_full: float
    clearance_margin: float  # m, distance to obstacles that leaves the robot room to turn in place
    excess: float  # largest ratio of an error to its bound in any held-out plan; above 1: outside
    in_place_windows: int = 0  # windows that turn in place, which have separate predictors; included in `windows`
    in_place_violations: int = 0  # of plans in place that left this tube, or that of all plans
    bound_in_place: float = 1.0  # probability that any part of a plan in place is outside, at 99 % confidence
    inflation: float = 1.0  # factor on the envelopes of the model set
    leaving: tuple[ViolationGroup, ...] = ()  # the violations by coordinate and driving regime
    marginal: float | None = None  # mode one-step: the share of new plans outside to expect, or more
    groups: tuple[GroupStatement, ...] = ()  # mode one-step: the statement by kind of driving
    chosen: Candidate | None = None  # mode one-step: the chosen features
    candidates: tuple[Candidate, ...] = ()  # mode one-step: all features tried, from the best to the worst
    unit: str = "m"  # of half-widths and errors of candidates; in joint space "1": shares of a limit's range

    def figures(self) -> dict[str, Any]:
        return asdict(self)


def upper_bound(violations: int, count: int) -> float:
    """Return the upper Clopper-Pearson bound on the probability of a violation, at 99 % confidence.

    Args:
        violations: number of violations.
        count: number of independent trials.
    """
    if count == 0 or violations >= count:
        return 1.0
    return float(betaincinv(violations + 1, count - violations, CONFIDENCE))


def most_violations(count: int, limit: float) -> int:
    """Return the largest number of violations for which the bound is still within a limit.

    Args:
        count: number of held-out plans.
        limit: largest accepted probability of a violation.

    Returns:
        The number of violations, or -1 if the plans are too few even without a violation.
    """
    most = -1
    while most + 1 < count and upper_bound(most + 1, count) <= limit:
        most += 1
    return most


def validate(model: ModelSet, fitted: Dataset, held_out: Dataset) -> ValidationReport:
    """Validate a model set fitted to `fitted` on the trajectories of `held_out`.

    >>> from brakeline import Dataset, ModelConfig, fit_model_set
    >>> fitted, held_out = Dataset.load(RECORDING).split((0.7, 0.3))
    >>> validate(fit_model_set(fitted, ModelConfig()), fitted, held_out).windows > 300
    True
    """
    return validate_plans(model, fitted, held_out)[0]


def validate_plans(model: ModelSet, fitted: Dataset, held_out: Dataset) -> tuple[ValidationReport, Array]:
    """Validate a model set, and return the excess of each held-out plan too.

    Args:
        model: the model set.
        fitted: the data set to which it was fitted.
        held_out: trajectories that are not in `fitted`.

    Returns:
        The validation report, and for each plan the largest ratio of an error to its bound (plans,).
    """
    robot, kind = model.robot, model.model_config.windows
    turning = model.turning()
    made_of = windows(fitted, robot.horizon, kind)
    figures: RegressorQuality = check_regressors(made_of.z, "plan windows", model.model_config.fewest)
    whole = windows(held_out, robot.horizon, kind)
    plans = non_overlapping(whole.take(~np.isnan(whole.stopping_distance)) if kind == PLAN else whole, robot.horizon)
    in_place = np.zeros(len(plans), dtype=bool)
    if model.in_place is not None:
        in_place = inside(plans.z, model.in_place.domain(plans.z.shape[1], robot.regressor_dim))
    # Plans in place must stay in both tubes: that of all plans verifies a solver's answer in place.
    groups = [(model, np.ones(len(plans), dtype=bool))] + ([] if turning is None else [(turning, in_place)])
    largest, first = _excess_of_plans(held_out, plans, groups)
    excess = largest.excess
    outside, steps_outside = int((~(excess <= 1.0)).sum()), int((~(first <= 1.0)).sum())
    turns, turns_outside = int(in_place.sum()), int((~(excess[in_place] <= 1.0)).sum())
    statement = _statement(
        model,
        (outside, len(plans)),
        (steps_outside, len(plans)),
        samples=figures.samples,
        rank=figures.rank,
        smallest_singular=figures.smallest,
        condition=figures.condition,
        excess=float(excess.max(initial=0.0)),
        in_place_windows=turns,
        in_place_violations=turns_outside,
        bound_in_place=upper_bound(turns_outside, turns),
        inflation=model.model_config.inflation,
        leaving=group_violations(excess, largest.parts, regimes(robot, plans.z)),
    )
    return statement, excess


class _LargestExcess:
    """The largest ratio of an error to its bound of each plan, and the part of the tube with that ratio."""

    def __init__(self, plans: int) -> None:
        self.excess, self.parts = np.zeros(plans), [""] * plans

    def update(self, places: NDArray[np.intp], shares: Array, names: list[str]) -> None:
        """Take in the ratios `shares` (places, names) of the plans `places`."""
        worst, largest = shares.argmax(1), shares.max(1)
        for row in np.flatnonzero(largest > self.excess[places]):
            self.parts[places[row]] = names[worst[row]]
        self.excess[places] = np.maximum(self.excess[places], largest)


def _excess_of_plans(
    held_out: Dataset, plans: Windows, groups: Sequence[tuple[ModelSet, NDArray[np.bool_]]]
) -> tuple[_LargestExcess, Array]:
    """Return the largest ratio of error to bound of each plan, and the ratios (plans,) after the first period.

    groups: each model set, and the plans (plans,) whose sets it predicts.
    """
    model = groups[0][0]
    robot, kind = model.robot, model.model_config.windows
    starts = {tuple(start) for start in plans.start}
    tubes = [of.tube_of_windows() for of, _ in groups]
    largest, first = _LargestExcess(len(plans)), np.zeros(len(plans))
    for k in range(1, robot.horizon + 1):
        seen = windows(held_out, k, kind)
        part = seen.take(np.array([tuple(start) in starts for start in seen.start], dtype=bool))
        for (of, members), tube in zip(groups, tubes, strict=True):
            if not members.any():
                continue
            group, places = part.take(members), np.flatnonzero(members)
            if k == 1:
                shares = _first_excess(of, group)
                first[members] = np.maximum(first[members], shares.max(1))
                largest.update(places, shares, state_parts(robot, shares.shape[1] - robot.state_dim))
            largest.update(places, *_excess(of, tube, group, k))
    return largest, first


def validate_one_step(model: ModelSet, calibration: Calibration) -> ValidationReport:
    """Return the statement of a model set of mode one-step, from its calibration (docs/method.md §13, §14).

    Every window was predicted without its fold. The bounds at 99 % confidence count windows that do not overlap: plans
    for `bound_plan`, periods for `bound_step`.
    """
    robot, s = model.robot, calibration.samples
    apart = non_overlapping_starts(s.start, robot.horizon)
    scores = np.where(np.isnan(calibration.scores), np.inf, calibration.scores)
    outside, first_outside = ~(scores <= 1.0), ~(calibration.first_scores <= 1.0)  # NaN is outside
    return _statement(
        model,
        (int(outside[apart].sum()), int(apart.sum())),
        (int(first_outside.sum()), len(s.z)),
        samples=len(s.v),
        rank=calibration.chosen.features,
        smallest_singular=calibration.smallest_singular,
        condition=calibration.condition,
        excess=float(scores.max(initial=0.0)),
        inflation=calibration.factor,
        marginal=_marginal(outside[apart]),
        groups=tuple(
            GroupStatement(
                name,
                int(kind.sum()),
                int((kind & apart).sum()),
                int((kind & apart & outside).sum()),
                _marginal(outside[kind & apart]),
                upper_bound(int((kind & apart & outside).sum()), int((kind & apart).sum())),
                float(scores[kind].max(initial=0.0)),
                int((kind & first_outside).sum()),
                upper_bound(int((kind & first_outside).sum()), int(kind.sum())),
            )
            for name, kind in driving_kinds(robot, s.z, s.start).items()
            if kind.any()
        ),
        unit="m" if robot.position_dim else "1",
        chosen=calibration.chosen,
        candidates=calibration.candidates,
    )


def _statement(model: ModelSet, plans: tuple[int, int], steps: tuple[int, int], **more: Any) -> ValidationReport:
    """Return the statement. plans, steps: the number of those outside, and of all; more: the other attributes."""
    robot, config, ready, bound_step = model.robot, model.model_config, Filter(model), upper_bound(*steps)
    return ValidationReport(
        certificate=config.certificate,
        mode=config.mode,
        version=model.version,
        windows=plans[1],
        violations=plans[0],
        step_violations=steps[0],
        bound_step=bound_step,
        bound_plan=upper_bound(*plans),
        bound_episode=1.0 - (1.0 - bound_step) ** EPISODE,
        outside_episode=bound_step * EPISODE,
        outside_hour=bound_step * HOUR / robot.period,
        half_width_rest=ready.half_width(np.zeros(robot.action_dim)),
        half_width_full=ready.half_width(np.asarray(robot.high())),
        clearance_margin=ready.clearance_margin,
        **more,
    )


def _marginal(outside: NDArray[np.bool_]) -> float:
    """Return about the largest share of new plans outside to expect, from plans (n,) of which these were outside.

    Windows that overlap are not exchangeable: errors that last as long as a plan are in many windows, or in none.
    """
    return (int(outside.sum()) + 1) / (len(outside) + 1)


def _first_excess(model: ModelSet, w: Windows) -> Array:
    """Return the ratio (T, n) of error to bound for each coordinate of the state after one period."""
    z = w.z if model.model_config.mode == DIRECT else model.first_regressor(w.z)
    half = np.concatenate([model.first.half_widths(z[i : i + CHUNK]) for i in range(0, len(z), CHUNK)])
    return np.asarray(shares_of(np.abs(outputs_of(model, w) - z @ model.first.C.T), half))


def outputs_of(model: ModelSet, w: Windows) -> Array:
    """Return the outputs of these windows that the model set's error bounds cover."""
    return predicted_outputs(model.robot, w.y) if model.model_config.mode == DIRECT else w.y


def _excess(model: ModelSet, tube: Tube, w: Windows, k: int) -> tuple[Array, list[str]]:
    """Return the ratio (T, parts) of error to bound for each part after k periods, and the names of the parts.

    The parts are position and further coordinates of the tube, chord deviation, and, at the end, stopping distance.
    """
    robot = model.robot
    d, more = robot.position_dim, list(extra_coordinates(robot))
    normals = facet_normals(tube.directions[k - 1][:, np.abs(tube.directions[k - 1]).any(0)])
    spread = np.abs(normals @ tube.directions[k - 1])  # (facets, L)
    others = outputs_of(model, w)[:, more]
    predicted = state_parts(robot, others.shape[1])
    names = [position_parts(robot)[axis] for axis in np.abs(normals).argmax(1)] + [predicted[i] for i in more]
    names += [PATH, AFTER] if k == tube.horizon else [PATH]
    excess = np.zeros((len(w), len(names)))
    for i in range(0, len(w), CHUNK):
        z = w.z[i : i + CHUNK]
        sizes = tube.magnitudes(z)
        magnitudes = sizes[:, : tube.generators]
        away = np.abs((w.y[i : i + CHUNK, :d] - z @ tube.position[k - 1].T) @ normals.T)
        off = np.abs(others[i : i + CHUNK] - z @ tube.more[k - 1].T)
        parts = [
            shares_of(away, magnitudes @ spread.T),
            shares_of(off, magnitudes @ np.abs(tube.more_directions[k - 1]).T),
            shares_of(w.chord_deviation[i : i + CHUNK, None], sizes[:, tube.generators + k - 1, None]),
        ]
        if k == tube.horizon:
            stopped = w.stopping_distance[i : i + CHUNK, None]
            parts.append(np.where(np.isnan(stopped), 0.0, shares_of(stopped, sizes[:, -1, None])))  # NaN: no stop
        excess[i : i + CHUNK] = np.concatenate(parts, axis=1)
    return excess, names


def facet_normals(generators: Array) -> Array:
    """Return the normals (facets, n) of a full-dimensional zonotope with generators (n, g), n <= 3.

    A point lies in the set exactly if it passes the support test in these directions and their opposites.

    Raises:
        ValueError: the zonotope has more than three dimensions.
    """
    n, count = generators.shape
    if n == 1:
        return np.ones((1, 1))
    if n == 2:
        normals = np.stack([-generators[1], generators[0]], axis=1)
    elif n == 3:
        pairs = list(combinations(range(count), 2))
        normals = np.cross(generators[:, [i for i, _ in pairs]].T, generators[:, [j for _, j in pairs]].T)
    else:
        raise ValueError(f"facets are enumerated up to 3 dimensions, not {n}")
    length = np.linalg.norm(normals, axis=1)
    return np.asarray(normals[length > 1e-14] / length[length > 1e-14, None])
