"""Choose few of many features for a least-squares fit: greedily, until another one is not worth its cost.

Minutes of driving determine few coefficients. Six variables have 210 products of up to four factors; a robot needs 10
to 30 of them.
Each step takes the feature that lowers the sum of squared errors most, given those before (forward selection), by
sweeping it out of the second moments (Goodnight 1979). The number of features is the one with the least
n log(sum of squares) + penalty · log(n) · (number of features). A penalty of 1 gives the Bayesian information criterion
(Schwarz 1978; docs/method.md §13).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MOST = 60  # features of one output
PATIENCE = 4  # features beyond the best number before the selection ends: two may be worth it only together
INDEPENDENT = 1e-9  # share of a feature's square that those before must leave


@dataclass(frozen=True)
class SelectionPath:
    """The order in which features are selected for one output, and what is left after each of them.

    Attributes:
        order (S,): indices of the features.
        squares (S + 1,): sums of squared errors with none, one, two, … of them.
        samples: number n of samples.
    """

    order: Index
    squares: Array
    samples: int

    @staticmethod
    def of(gram: Array, cross: Array, square: float, samples: int, penalty: float) -> SelectionPath:
        """Select features until the criterion with this penalty, the smallest of interest, no longer falls.

        Args:
            gram (F, F): second moments ΦᵀΦ of the features, summed over the samples.
            cross (F,): Φᵀy.
            square: yᵀy.
            samples: number of samples.
            penalty: see `best`.
        """
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        left, gain_of = gram / np.outer(size, size), cross / size
        order: list[int] = []
        squares, best, least = [square], 0, samples * np.log(max(square, 1e-300))
        free = np.ones(len(size), dtype=bool)
        while len(order) < MOST:
            own = np.diag(left)
            gains = np.where(free & (own > INDEPENDENT), gain_of**2 / np.maximum(own, INDEPENDENT), 0.0)
            chosen = int(gains.argmax())
            if gains[chosen] <= 0.0:
                break
            free[chosen] = False
            order.append(chosen)
            squares.append(max(squares[-1] - float(gains[chosen]), 1e-300))
            column, pivot = left[:, chosen].copy(), own[chosen]
            gain_of = gain_of - column * (gain_of[chosen] / pivot)
            left = left - np.outer(column, column / pivot)
            criterion = samples * np.log(squares[-1]) + penalty * np.log(samples) * len(order)
            if criterion < least:
                best, least = len(order), criterion
            elif len(order) >= best + PATIENCE:
                break
        return SelectionPath(np.array(order, dtype=np.int64), np.array(squares), samples)

    def best(self, penalty: float) -> Index:
        """Return the indices of the features with the least criterion. A larger penalty never gives more."""
        counts = np.arange(len(self.squares))
        criterion = self.samples * np.log(np.maximum(self.squares, 1e-300)) + penalty * np.log(self.samples) * counts
        return self.order[: int(criterion.argmin())]
