"""Time one step of lemma 2 with the factored matrix zonotope, and with its T·γ generators multiplied out."""

from __future__ import annotations

import numpy as np

from benchmarks import situations
from benchmarks.timing import Figures, timed
from brakeline.safety.model.error_bounds import ErrorBound


def multiplied_out(step: ErrorBound, z: np.ndarray) -> np.ndarray:
    """Return the half-widths from all generator matrices `M_jt g_j h_tᵀ`, as a matrix zonotope is usually stored."""
    matrices = step.generators.T[:, None, :, None] * (step.M[:, :, None] * step.W[None])[:, :, None, :]
    spread = np.abs(matrices.reshape(-1, *step.C.shape) @ z).sum(0)
    return np.asarray(spread + np.abs(step.generators) @ (step.kappa @ np.abs(z) + step.w))


def run() -> Figures:
    """Return a row for each form."""
    step = situations.model("matrix-zonotope").steps[-1]
    z = np.full(step.C.shape[1], 0.1)
    assert np.allclose(multiplied_out(step, z), step.half_widths(z))
    return {
        f"factored, {len(step.W)} samples": timed(lambda: step.half_widths(z), 500),
        f"multiplied out, {step.M.size} generator matrices": timed(lambda: multiplied_out(step, z), 10),
    }
