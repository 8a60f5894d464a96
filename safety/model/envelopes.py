"""Affine bounds of samples, as tight as possible at chosen features (docs/method.md §1c)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import ErrorBoundError
from brakeline.safety.model.linear_program import OPTIMAL, LinearProgram

Array = NDArray[np.float64]

ROWS_A_ROUND = 64  # samples that each round adds to a linear program
VIOLATED = 1e-7  # share of the largest value by which a sample must exceed a bound to be added


class Envelopes:
    """Envelopes of several coordinates: κ_i f + w_i >= v_i for all samples, with κ_i and w_i not negative.

    A linear program for each coordinate minimises its bound at chosen features. It starts from few samples and adds
    violated ones until there are none. What its tolerance leaves violated is added to w.

    >>> Envelopes(np.array([[0.0], [1.0], [2.0]]), np.array([[1.0], [2.0], [3.0]])).tightest()
    (array([[1.]]), array([1.]))
    """

    def __init__(self, features: Array, values: Array) -> None:
        """Take samples, none negative: features (T, q) and values (T, n).

        Raises:
            ErrorBoundError: there is no sample, or a number is not finite.
        """
        if not len(values):
            raise ErrorBoundError("no sample to bound")
        if not (np.isfinite(features).all() and np.isfinite(values).all()):
            raise ErrorBoundError("no envelope of the residuals: there are NaN or infinity")
        rows = np.column_stack([features, np.ones(len(features))])
        self._mean, largest = features.mean(0), rows.max(0)
        self._size = np.where(largest > 0.0, largest, 1.0)  # the solver's tolerances are absolute
        rows /= self._size
        self._coordinates = [_Envelope(rows, np.ascontiguousarray(v), rows.argmax(0)) for v in values.T]

    def tightest(self, typical: Array | None = None, inflation: float = 1.0) -> tuple[Array, Array]:
        """Return κ (n, q) and w (n,), times `inflation`, with the least bounds at the features `typical`.

        typical (q,) or (n, q): one for all coordinates, or one for each; by default the samples' mean.
        """
        shape = len(self._coordinates), len(self._size) - 1
        each = np.broadcast_to(self._mean if typical is None else typical, shape)
        costs = np.column_stack([each, np.ones(len(each))]) / self._size
        bounds = [one.tightest(cost) for one, cost in zip(self._coordinates, costs, strict=True)]
        scaled = np.array(bounds) / self._size * inflation
        return scaled[:, :-1], scaled[:, -1]


class _Envelope:
    """The envelope of one coordinate, as a linear program."""

    def __init__(self, rows: Array, values: Array, first: NDArray[np.int64]) -> None:
        """Take samples: rows (T, q + 1), values (T,). first: some to start from, besides those of large values."""
        self._scale = float(values.max()) or 1.0
        self._rows, self._values = rows, values / self._scale
        self._held = np.zeros(len(values), dtype=bool)  # the samples in the program
        self._program = LinearProgram(rows.shape[1], least=0.0)
        self._hold(np.union1d(_largest(values), first))

    def _hold(self, samples: NDArray[np.int64]) -> None:
        self._held[samples] = True
        self._program.add(self._rows[samples], self._values[samples], np.full(len(samples), np.inf))

    def tightest(self, cost: Array) -> Array:
        """Return the bound [κ, w] (q + 1,) with the least cost."""
        while True:
            state, solution = self._program.minimise(cost)
            if state != OPTIMAL:
                raise ErrorBoundError(f"no envelope of the residuals: {state}")
            bound = np.maximum(solution, 0.0)
            short = self._values - self._rows @ bound
            worst = _largest(short)
            more = worst[(short[worst] > VIOLATED) & ~self._held[worst]]
            if not len(more):
                bound[-1] += max(float(short.max()), 0.0) + 1e-9
                return np.asarray(bound * self._scale)
            self._hold(np.sort(more))


def _largest(values: Array) -> NDArray[np.int64]:
    """Return the indices of the `ROWS_A_ROUND` largest values (T,), in no order."""
    return np.argpartition(values, -min(ROWS_A_ROUND, len(values)))[-ROWS_A_ROUND:]
