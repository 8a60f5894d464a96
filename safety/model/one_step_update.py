"""Update a model set of mode one-step to minutes of new driving (docs/method.md §15).

A fit to a few minutes alone is narrow: it knows the speeds of these minutes, and states nothing beyond. An update keeps
what the model set in use knows: the features, the shape of its sets and its domain. The old recording counts as data of
a lower weight, from the second moments that the model set holds. The new driving alone scales the sets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import ErrorBoundError
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.calibration_samples import Samples, samples_of
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.driving_kinds import JUMPING, driving_kinds
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.fitting import stopping_distance_of_stops
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.one_step import OneStep
from brakeline.safety.model.one_step_fitting import (
    PLANS_EVERY,
    Calibration,
    scales,
    window_scores,
    window_shares,
)
from brakeline.safety.model.one_step_regression import RIDGE, Candidate
from brakeline.safety.model.set_factors import SetFactors
from brakeline.safety.model.set_shape import plans_from, shares, stop_from_full_speed
from brakeline.safety.model.windows import recorded_domain

OLD_WEIGHTS = (10.0, 1.0, 0.1, 0.01)  # periods of the old recording, for each new period


@dataclass(frozen=True)
class Correction:
    """Least squares for the change of a predictor's coefficients, from the new periods of each fold.

    The coefficients C' minimise the squared errors of the new periods, and with a weight ρ those of the old ones:

        C' = C + D,    (Φᵀ Φ + ρ G) Dᵀ = Φᵀ (y - Φ Cᵀ)

    with the old second moments G of the features. With instruments, Φᵀ is that of the predicted speeds (§13).

    Attributes:
        before: the predictor in use.
        old (F, F): G.
        gram (folds, F, F), mixed (2, folds, F, F), cross (2, folds, F, n): ΦᵀΦ; its replacement and the right-hand
            side, without and with instruments.
    """

    before: OneStep
    old: Array
    gram: Array
    mixed: Array
    cross: Array

    @staticmethod
    def of(robot: Robot, before: OneStep, s: Samples) -> Correction:
        """Return the second moments of the new periods."""
        half = np.linalg.inv(before.root)
        phi = before.features(s.v)
        off = s.y - phi @ before.C.T
        known = s.follows.copy()
        known[1:] &= s.period_fold[1:] == s.period_fold[:-1]
        predicted = (phi @ before.C.T)[np.flatnonzero(known) - 1][:, list(robot.regressor)]
        instruments = np.zeros_like(phi)
        instruments[known] = before.features(np.hstack([predicted, s.v[known, len(robot.regressor) :]]))
        folds = [s.period_fold == i for i in range(int(s.period_fold.max()) + 1)]
        left = phi, instruments
        mixed = np.array([[one[fold].T @ phi[fold] for fold in folds] for one in left])
        cross = np.array([[one[fold].T @ off[fold] for fold in folds] for one in left])
        return Correction(before, half @ half.T, mixed[0], mixed, cross)

    def fit(self, old_weight: float, instruments: bool, without: int = -1) -> OneStep:
        """Return the predictor from all folds but one. old_weight: periods of the old recording for each new one."""
        folds = [i for i in range(len(self.gram)) if i != without]
        gram, mixed, cross = (
            self.gram[folds].sum(0),
            *(m[int(instruments)][folds].sum(0) for m in (self.mixed, self.cross)),
        )
        old = old_weight * gram[0, 0] / self.old[0, 0] * self.old  # feature 0 is the constant 1: it counts periods
        ridge = np.diag(RIDGE * np.diag(gram + old))
        change = np.linalg.solve(mixed + old + ridge, cross).T
        root = np.linalg.inv(np.linalg.cholesky(gram + old + ridge))
        return replace(self.before, C=self.before.C + change, root=root, start=1.0)


@dataclass(frozen=True)
class Trial:
    """A way to update the predictor, and the sets that it needs.

    Attributes:
        old_weight, instruments: of `Correction.fit`.
        one_step: the predictor.
        factors: on the half-widths, from the out-of-fold scores.
        scores: out-of-fold scores of the windows (`window_scores`).
        width: mean factor on the last sets.
    """

    old_weight: float
    instruments: bool
    one_step: OneStep
    factors: SetFactors
    scores: tuple[Array, Array, Array]
    width: float


def update_one_step(in_use: ModelSet, data: Dataset, outside: float) -> tuple[ModelSet, Calibration]:
    """Update a model set to new driving. It keeps at least the domain of the model set, and no set is scaled down.

    outside: the share of the new windows that may leave their sets, in every kind of driving.

    Raises:
        BadData: there is too little driving, or too few stops; the message says what to record.
        ErrorBoundError: the model set is of another mode.
    """
    robot, before = data.robot, in_use.one_step
    if before is None:
        raise ErrorBoundError("only a model set of mode one-step can be updated")
    s = samples_of(data.joined())
    correction, kinds = Correction.of(robot, before, s), driving_kinds(robot, s.z, s.start)
    kinds[JUMPING] = np.zeros(len(s.z), dtype=bool)  # none is left out: the robot may go on to drive like that
    chords = in_use.chord_deviations.half_widths(s.z)[..., None]
    widths = np.concatenate([np.stack([step.half_widths(s.z) for step in in_use.steps], 1), chords], axis=2)
    choices = product(OLD_WEIGHTS, (False, True))
    trials = [_tried(in_use, s, correction, widths, kinds, choice, outside) for choice in choices]
    best = min(trials, key=lambda trial: trial.width if np.isfinite(trial.width) else np.inf)
    first, later, of_chords = scales(robot, best.factors, s.after.shape[2])
    recorded = recorded_domain(data)
    model = replace(
        in_use,
        robot=robot,
        layout="",
        model_config=replace(in_use.model_config, outside=outside),
        steps=(_scaled(in_use.steps[0], first), *(_scaled(step, later) for step in in_use.steps[1:])),
        chord_deviations=_scaled(in_use.chord_deviations, of_chords),
        stopping_distance=_scaled(in_use.stopping_distance, _stopping_factor(in_use, data, s)),
        domain=np.stack([np.minimum(in_use.domain[0], recorded[0]), np.maximum(in_use.domain[1], recorded[1])]),
        about=data.about | {"data": data.digest(), "periods": str(data.periods), "updates": in_use.version},
        one_step=replace(best.one_step, start=best.factors.start),
    )
    scores, positions, others = best.scores
    used, used_first = (best.factors.shares(part, others, kinds) for part in (scores, positions))
    features = Candidate(0, 1, best.old_weight, best.instruments, features=len(best.one_step.features.terms))
    return model, Calibration(features, (), float(best.factors.plan.max()), used, used_first, s, 0.0, 0.0)


def _tried(
    in_use: ModelSet,
    s: Samples,
    correction: Correction,
    widths: Array,
    kinds: dict[str, NDArray[np.bool_]],
    choice: tuple[float, bool],
    outside: float,
) -> Trial:
    """Update the predictor in one way, and score every window without its fold.

    widths (T, N, n' + 1): half-widths of the model set in use.
    """
    robot = in_use.robot
    scores = window_scores(robot, _shares_used(robot, s, correction, choice, widths))
    factors = SetFactors.of(scores[0], scores[2], kinds, outside, same=not robot.position_dim)
    one_step, mean = correction.fit(*choice), float(np.exp(np.log(factors.plan).mean()))
    return Trial(*choice, one_step, factors, scores, mean * _stretched(in_use, s, one_step))


def _shares_used(robot: Robot, s: Samples, correction: Correction, choice: tuple[float, bool], widths: Array) -> Array:
    """Return how much of its half-widths (T, N, n' + 1) each window used, each predicted without its fold."""
    used = np.zeros_like(widths)
    for i in range(len(correction.gram)):
        held, one_step = s.fold == i, correction.fit(*choice, without=i)
        with np.errstate(invalid="ignore"):  # a rollout may diverge: `shares` takes NaN for infinity
            predicted, stretch = one_step.rollouts_with_stretch(robot, s.z[held])
            errors = (s.after[held] - predicted) / stretch[..., None]
        used[held] = window_shares(errors, s.chords[held], widths[held])
    return used


def _stretched(in_use: ModelSet, s: Samples, one_step: OneStep) -> float:
    """Return the geometric mean of how much more the last sets grow with the leverage than those in use.

    Plans from the starts of the new windows count for one half, and a stop from full speed for the other.
    """
    robot, before = in_use.robot, in_use.one_step
    assert before is not None
    plans, full = plans_from(robot, s.z[::PLANS_EVERY]), stop_from_full_speed(robot, s.z, one_step)
    ratios = [one_step.last_stretches(robot, z) / before.last_stretches(robot, z) for z in (plans, full)]
    return float(np.exp(np.mean([np.log(ratio).mean() for ratio in ratios])))


def _stopping_factor(in_use: ModelSet, data: Dataset, s: Samples) -> float:
    """Return the factor on the bound of the way after a plan's end, at least 1. Raises BadData: too few stops."""
    stopping_distance_of_stops(data, in_use.model_config)
    ended = ~np.isnan(s.stops)
    ratios = shares(s.stops[ended], in_use.stopping_distance.half_widths(s.z[ended])[:, 0])
    return max(1.0, in_use.model_config.inflation * float(ratios.max(initial=0.0)))


def _scaled(bound: ErrorBound, factor: float | Array) -> ErrorBound:
    """Return a bound whose generators are axes, times a factor (g,) on each."""
    by = np.broadcast_to(factor, bound.w.shape)
    return replace(bound, M=by[:, None] * bound.M, kappa=by[:, None] * bound.kappa, w=by * bound.w)
