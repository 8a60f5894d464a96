"""Error bounds of a predictor from recorded data: one form, three kinds (docs/method.md §1; Lemmas 1 and 2).

Every kind of error bound has form (1) of docs/method.md, for a regressor z (nz,):

    y+ ∈ C z + Σ_j ( M_j·|W z| + κ_j·|z| + w_j ) g_j [-1, 1]

The generators g_j share the rows of W.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import ErrorBoundError
from brakeline.safety.model.envelopes import ROWS_A_ROUND, Envelopes
from brakeline.safety.model.linear_program import INFEASIBLE, OPTIMAL, UNBOUNDED, LinearProgram

Array = NDArray[np.float64]

NO_BOX = {  # why there is no hull of the consistent matrices
    UNBOUNDED: "the samples do not bound the matrix",
    INFEASIBLE: "no matrix is consistent with all samples: the noise bound is too small",
}


@dataclass(frozen=True)
class ErrorBound:
    """y ∈ C z + Σ_j ( M_j |W z| + κ_j |z| + w_j ) g_j [-1, 1]        (docs/method.md §1, form 1).

    Attributes:
        C (n, nz): linear predictor. W (q, nz): rows that all generators share.
        M (g, q), kappa (g, nz), w (g,): non-negative lengths. generators (n, g): g_j as columns.
    """

    C: Array
    W: Array
    M: Array
    kappa: Array
    w: Array
    generators: Array

    def __post_init__(self) -> None:
        """Use one memory layout for all arrays: the order of summation, and so the last bit, depends on it."""
        for name in ("C", "W", "M", "kappa", "w", "generators"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=float))

    def magnitudes(self, z: Array) -> Array:
        """Return the lengths (..., g) of the generators for regressors z (..., nz)."""
        return np.asarray(np.abs(z @ self.W.T) @ self.M.T + np.abs(z) @ self.kappa.T + self.w)

    def half_widths(self, z: Array) -> Array:
        """Return half-widths (..., n) of the interval hull of the bound for regressors z (..., nz)."""
        return np.asarray(self.magnitudes(z) @ np.abs(self.generators).T)

    def through(self, T: Array) -> ErrorBound:
        """Return this bound, which is about z' = T z with T (nz', nz), as a bound about z."""
        unbent = np.zeros((len(self.w), T.shape[1]))
        return ErrorBound(
            self.C @ T,
            np.vstack([self.W @ T, T]),
            np.hstack([self.M, self.kappa]),
            unbent,
            self.w,
            self.generators,
        )

    def outer(self, basis: Array) -> ErrorBound:
        """Return an outer bound with `basis` B (nz, nz) in place of W: for the QP, whose size grows with the rows of W.

        M |W z| = M |(W B⁻¹)(B z)| <= M |W B⁻¹| |B z|                          (docs/method.md §2)
        """
        if len(self.W) <= len(basis):
            return self
        spread = np.abs(np.linalg.solve(basis.T, self.W.T).T)
        return ErrorBound(self.C, basis, self.M @ spread, self.kappa, self.w, self.generators)


def least_squares(z: Array, y: Array, columns: NDArray[np.bool_] | None = None) -> Array:
    """Return C (n, nz) of least squares for regressors z (T, nz) and targets y (T, n), zero outside `columns`."""
    C = np.zeros((y.shape[1], z.shape[1]))
    chosen = slice(None) if columns is None else columns
    C[:, chosen] = np.linalg.lstsq(z[:, chosen], y, rcond=None)[0].T
    return C


def whitening(z: Array) -> Array:
    """Return B (nz, nz) with `B z` white over the samples z (T, nz); raise ErrorBoundError if they do not span."""
    moment = z.T @ z / len(z)
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(moment)))
    except np.linalg.LinAlgError:
        raise ErrorBoundError("the regressors do not span their space: record more varied inputs") from None


def residual(z: Array, y: Array, C: Array, inflation: float = 1.0) -> ErrorBound:
    """Return bound (c): the predictor C (n, nz), and an envelope of its residual over z (T, nz), y (T, n)."""
    n, nz = C.shape
    rest = np.abs(y - z @ C.T)
    kappa, w = Envelopes(np.abs(z), rest).tightest(inflation=inflation)
    return ErrorBound(C, np.zeros((0, nz)), np.zeros((n, 0)), kappa, w, np.eye(n))


def matrix_zonotope(z: Array, y: Array, generators: Array, sizes: Array, kappa: Array, w: Array) -> ErrorBound:
    """Return bound (a): all matrices (Y - noise) Z⁺ of Lemma 1, exactly, plus the noise of the step (Lemma 2).

    The noise at sample t is `Σ_j sizes[j, t] g_j [-1, 1]`, centred: every generator matrix has rank one,
    `g_j h_tᵀ` with h_t row t of Z⁺, and for a fixed z the terms of one g_j are parallel.

    Args:
        z: (T, nz); y: (T, n), the noise's centre subtracted; generators: (n, g); sizes: (g, T).
        kappa, w: (g, nz) and (g,), the noise of the predicted step.
    """
    pseudo = np.asarray(np.linalg.pinv(z.T), dtype=float)
    return ErrorBound(y.T @ pseudo, pseudo, sizes, kappa, w, generators)


def set_membership(z: Array, y: Array, sizes: Array, kappa: Array, w: Array) -> ErrorBound:
    """Return bound (b): for each coordinate, all rows a with |y_t - aᵀ z_t| <= sizes[t], boxed in white coordinates.

    Args:
        z: (T, nz); y: (T, n); sizes: (n, T); kappa, w: (n, nz) and (n,), the noise of the predicted step.

    Raises:
        ErrorBoundError: no matrix is consistent with all samples: the noise bound is too small.
    """
    basis = whitening(z)
    white = z @ basis.T
    low, high = np.zeros((y.shape[1], z.shape[1])), np.zeros((y.shape[1], z.shape[1]))
    for j in range(y.shape[1]):
        low[j], high[j] = _row_box(white, y[:, j], sizes[j])
    C, half = 0.5 * (low + high) @ basis, 0.5 * (high - low)
    return ErrorBound(C, basis, half, kappa, w, np.eye(y.shape[1]))


def _row_box(white: Array, y: Array, size: Array) -> tuple[Array, Array]:
    """Return the interval hull of the polytope |y_t - aᵀ white_t| <= size_t, by 2 nz linear programs.

    They share their active samples. Samples left out only widen the hull, so every result is an outer bound.
    """
    nz, unit = white.shape[1], float(size.mean()) or 1.0
    y, size = y / unit, size / unit  # the solver's tolerances are absolute
    program, active = LinearProgram(nz, least=-np.inf), np.zeros(len(y), dtype=bool)

    def hold(samples: NDArray[np.int64]) -> None:
        new = np.unique(samples[~active[samples]])
        active[new] = True
        program.add(white[new], y[new] - size[new], y[new] + size[new])

    hold(np.concatenate([np.argsort(size)[:ROWS_A_ROUND], np.abs(white).argmax(0)]))
    corners = np.zeros((2, nz))
    for axis, (side, sign) in product(range(nz), enumerate((1.0, -1.0))):
        while True:
            state, row = program.minimise(sign * np.eye(nz)[axis])
            if state == UNBOUNDED and not active.all():  # so it seems, on so few samples
                spread = np.arange(0, len(y), max(1, len(y) // (4 * ROWS_A_ROUND)))
                hold(spread if not active[spread].all() else np.arange(len(y)))
                continue
            if state != OPTIMAL:
                raise ErrorBoundError(NO_BOX.get(state, f"no bound of the consistent matrices: {state}"))
            over = np.abs(y - white @ row) - size
            worst = np.argsort(over)[-ROWS_A_ROUND:]
            more = worst[(over[worst] > 1e-6) & ~active[worst]]
            if not len(more):
                break
            hold(more)
        corners[side, axis] = row[axis] - sign * 1e-6
    return unit * corners[0], unit * corners[1]
