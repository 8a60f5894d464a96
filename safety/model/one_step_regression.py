"""Fit a one-step predictor to recorded periods: few features for each output (docs/method.md §13)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.calibration_samples import Samples
from brakeline.safety.model.feature_selection import SelectionPath
from brakeline.safety.model.one_step import Features, OneStep

Index = NDArray[np.int64]

PENALTIES = (1.0, 3.0)  # of the selection
RIDGE = 1e-9  # of the fit, as a share of each feature's square: for features that nearly depend on each other
ABSURD = 100.0  # times the largest recorded value: so far leads only a prediction whose features feed each other
MOST_AT_ONCE = 10_000  # periods whose features are in memory at once


@dataclass(frozen=True)
class Candidate:
    """A way to fit the predictor, and its out-of-fold error.

    Attributes:
        degree, lags: of the features to select from (`features_for`).
        penalty: of the selection (`SelectionPath`).
        instruments: whether the coefficients come from instrumental variables.
        error [m]: the 99 % quantile of the distance between predicted and measured position, over all windows and
            periods, each predicted without its fold. In joint space, of the largest error of a limit's value, in units
            of `Robot.limit_scales`.
        features: number of selected features.
    """

    degree: int
    lags: int
    penalty: float
    instruments: bool
    error: float = np.nan
    features: int = 0


class Regression:
    """Fits to all folds, or to all but one, from the second moments of each fold."""

    def __init__(self, robot: Robot, features: Features, s: Samples) -> None:
        """Take the features to select from, and the recorded driving."""
        self._robot, self._features, self._s = robot, features, s
        count, n = len(features.terms), s.y.shape[1]
        folds = int(s.period_fold.max()) + 1
        self.folds = range(folds)
        self._gram, self._cross = np.zeros((folds, count, count)), np.zeros((folds, count, n))
        for i in self.folds:
            rows = np.flatnonzero(s.period_fold == i)
            for some in np.array_split(rows, len(rows) // MOST_AT_ONCE + 1):
                phi = features(s.v[some])
                self._gram[i] += phi.T @ phi
                self._cross[i] += phi.T @ s.y[some]
        self._paths: dict[int, list[SelectionPath]] = {}
        self._fits: dict[tuple[float, bool, int], OneStep] = {}

    def fit(self, candidate: Candidate, without: int = -1, weight: float = 0.0) -> OneStep:
        """Return the predictor that is fitted to all folds but one, with a weight of the leverage."""
        key = candidate.penalty, candidate.instruments, without
        if key not in self._fits:
            self._fits[key] = self._fitted(candidate, without)
        return replace(self._fits[key], weight=weight)

    def _fitted(self, candidate: Candidate, without: int) -> OneStep:
        folds = [i for i in self.folds if i != without]
        gram, cross = self._gram[folds].sum(0), self._cross[folds].sum(0)
        chosen = [path.best(candidate.penalty) for path in self._paths_without(without, gram, cross)]
        used = np.unique(np.concatenate([[0], *chosen]))  # the constant, for an output without features
        places = [np.searchsorted(used, one) for one in chosen]
        features, gram, cross = self._features.subset(used), gram[np.ix_(used, used)], cross[used]
        gram = gram + np.diag(RIDGE * np.diag(gram) + 1e-12 * gram[0, 0])
        C = _solved(places, gram, cross)
        if candidate.instruments:
            C = self._by_instruments(features, C, places, without)
        root = np.linalg.inv(np.linalg.cholesky(gram))
        return OneStep(C, features, root)

    def _paths_without(self, without: int, gram: Array, cross: Array) -> list[SelectionPath]:
        if without not in self._paths:
            y = self._s.y[self._s.period_fold != without]
            squares, least = (y**2).sum(0), min(PENALTIES)
            of_outputs = zip(cross.T, squares, strict=True)
            self._paths[without] = [SelectionPath.of(gram, c, float(q), len(y), least) for c, q in of_outputs]
        return self._paths[without]

    def _by_instruments(self, features: Features, C: Array, places: list[Index], without: int) -> Array:
        """Return the coefficients from instrumental variables.

        Least squares ignores the errors of measured speeds, so it makes their coefficients too small, and the effect
        accumulates in a rollout. The instruments are the features of the speeds that the period before predicts: they
        follow the true speeds, and are independent of the errors of the measured ones.
        """
        s, r = self._s, len(self._robot.regressor)
        good = s.follows & (s.period_fold != without)
        good[1:] &= s.period_fold[1:] == s.period_fold[:-1]
        known = np.flatnonzero(good)
        mixed, cross = np.zeros((len(features.terms),) * 2), np.zeros((len(features.terms), len(C)))
        for some in np.array_split(known, len(known) // MOST_AT_ONCE + 1):
            predicted = features(s.v[some - 1]) @ C[list(self._robot.regressor)].T
            instruments = features(np.hstack([predicted, s.v[some][:, r:]]))
            mixed += instruments.T @ features(s.v[some])
            cross += instruments.T @ s.y[some]
        return _solved(places, mixed + np.diag(RIDGE * np.abs(np.diag(mixed))), cross)

    def quality(self, one_step: OneStep) -> tuple[float, float]:
        """Return the smallest singular value and the condition number of the scaled features of a predictor."""
        phi = one_step.features(self._s.v)
        scaled = phi / np.sqrt(np.maximum((phi**2).sum(0), 1e-300))
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(scaled.T @ scaled), 0.0))
        return float(singular[0]), float(singular[-1] / max(singular[0], 1e-300))

    def diverges(self, candidate: Candidate, z: Array) -> bool:
        """Return whether a fit to all folds, or to all but one, leads absurdly far away in one of these windows z."""
        most = ABSURD * np.abs(self._s.after).max((0, 1))
        fits = (self.fit(candidate, without=i) for i in (*self.folds, -1))
        # NaN diverges, too
        return not all((np.abs(one_step.rollouts(self._robot, z)) <= most).all() for one_step in fits)

    def out_of_fold(self, candidate: Candidate, s: Samples) -> Array:
        """Return the errors (T, N, n + d·discs) of windows, each predicted without its fold."""
        predictions = np.empty_like(s.after)
        for i in self.folds:
            held = s.fold == i
            predictions[held] = s.after[held] - self.fit(candidate, without=i).rollouts(self._robot, s.z[held])
        return predictions


def _solved(places: list[Index], gram: Array, cross: Array) -> Array:
    """Return the coefficients (n, F) of each output, which has only the features at its places."""
    C = np.zeros((cross.shape[1], len(gram)))
    for i, used in enumerate(places):
        try:
            C[i, used] = np.linalg.solve(gram[np.ix_(used, used)], cross[used, i])
        except np.linalg.LinAlgError:  # the instruments do not determine them: `choose` drops the candidate
            C[i, used] = np.nan
    return C
