"""Sets of models from recorded periods, and the tubes that they predict: peers of `brakeline.safety.model.one_step`.

Both hold every matrix A with y_t = A φ_t + e_t, |e_t| <= noise_t, for the recorded periods t, and propagate boxes:

- zonotopic recursive least squares (Naderi Akhormeh et al., "Online data-driven reachability analysis using zonotopic
  recursive least squares", arXiv 2509.17058; TUM-CPS-HN/ZRLS): with forgetting λ, K = P φ / (φᵀ P φ + λ R),
  P ← (I − K φᵀ) P / λ, centre ← centre + K (y − centre φ), generators ← generators (I − K φᵀ)ᵀ / √λ, and a new one,
  −K noise, for each output.
- constrained matrix zonotopes (Alanwar et al., "Data-driven reachability analysis from noisy data", IEEE TAC 2023,
  arXiv 2105.07229; aalanwar/Data-Driven-Reachability-Analysis): A = (Y − W) Φ⁺, with the noise W in a matrix zonotope
  and (Y − W) Φ⊥ = 0. These are the matrices that are consistent with all samples.

Both handle polynomial systems as here: φ are monomials, and a box of states gives a box of φ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from brakeline.compilation import compiled
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.calibration_samples import Samples
from brakeline.safety.model.envelopes import Envelopes
from brakeline.safety.model.error_bounds import least_squares, whitening
from brakeline.safety.model.model_config import ModelConfig
from brakeline.safety.model.one_step import Features

DIRECTIONS = 300  # recorded φ in whose directions the consistent models are bounded to find the samples that matter
MOST_EDGES = 10_000  # that a linear program follows
ROUNDING = 1e-10  # of a multiplier or a slope, relative to the largest entry


@dataclass(frozen=True)
class Noise:
    """The bound of the error of one period, |e| <= κ |v| + w; κ (n, v), w (n,)."""

    kappa: Array
    w: Array

    def sizes(self, v: Array) -> Array:
        """Return the bound (T, n) for variables v (T, v) with these absolute values."""
        return np.asarray(np.abs(v) @ self.kappa.T + self.w)

    @staticmethod
    def of(features: Features, s: Samples) -> Noise:
        """Return the envelopes of the out-of-fold errors, scaled to the quantile of the one-step form."""
        phi, off = features(s.v), np.empty_like(s.y)
        for fold in np.unique(s.period_fold):
            held = s.period_fold == fold
            off[held] = s.y[held] - phi[held] @ least_squares(phi[~held], s.y[~held]).T
        noise = Noise(*Envelopes(np.abs(s.v), np.abs(off)).tightest())
        scores = np.sort((np.abs(off) / noise.sizes(s.v)).max(1))
        factor = scores[min(math.ceil((len(scores) + 1) * (1.0 - ModelConfig.outside)), len(scores)) - 1]
        return Noise(factor * noise.kappa, factor * noise.w)


class Models(Protocol):
    """A set of matrices A."""

    @property
    def C(self) -> Array:
        """The centre (n, F)."""

    @property
    def box(self) -> Array:
        """The largest |A − C| (n, F), element by element."""

    def spread(self, phi: Array) -> tuple[Array, Array]:
        """Return the least and the largest (A − C) φ (T, n) for features φ (T, F)."""


@dataclass(frozen=True)
class LeastSquaresZonotope:
    """The matrix zonotope of zonotopic recursive least squares: C + Σ_tj β_tj g_j sizes_tj h_tᵀ, |β| <= 1.

    The recursion adds a generator for each sample and output. For λ = 1, which forgets nothing, its result has a closed
    form: C is least squares, and h_t = P φ_t, with P the inverse of Σ_t φ_t φ_tᵀ. This is the matrix zonotope of
    Lemma 1 for the same features.

    Attributes:
        H (T, F): rows h_t. sizes (T, n): noise of each sample.
    """

    C: Array
    H: Array
    sizes: Array
    box: Array

    @staticmethod
    def fit(phi: Array, y: Array, sizes: Array) -> LeastSquaresZonotope:
        moment = phi.T @ phi
        C, H = (np.asarray(np.linalg.solve(moment, right).T, float) for right in (phi.T @ y, phi.T))
        return LeastSquaresZonotope(C, H, sizes, sizes.T @ np.abs(H))

    def spread(self, phi: Array) -> tuple[Array, Array]:
        half = np.concatenate(
            [np.abs(part @ self.H.T) @ self.sizes for part in np.array_split(phi, len(phi) // 64 + 1)]
        )
        return -half, half


@compiled("f8(f8[:,::1], f8[::1], f8[::1], i8[::1])")
def climb(rows: Array, limits: Array, direction: Array, vertex: NDArray[np.int64]) -> float:
    """Return the largest direction · x with rows x <= limits, NaN if there is none; the simplex method.

    Climb from vertex to vertex. `vertex` has the rows (F,) that meet in the first one, and then those of the last one.
    """
    steepest = ROUNDING * np.abs(direction).max()
    for _ in range(MOST_EDGES):
        edges = np.linalg.inv(rows[vertex])
        multipliers = direction @ edges
        leaving = int(multipliers.argmin())
        if multipliers[leaving] >= -steepest:
            return float(multipliers @ limits[vertex])
        along = -np.ascontiguousarray(edges[:, leaving])
        gain, slack = rows @ along, limits - rows @ (edges @ limits[vertex])
        least = ROUNDING * np.abs(along).max()
        nearest, entering = np.inf, -1
        for i in range(len(gain)):
            if gain[i] > least and slack[i] / gain[i] < nearest and not (vertex == i).any():
                nearest, entering = slack[i] / gain[i], i
        if entering < 0:
            break
        vertex[leaving] = entering
    return np.nan


@dataclass(frozen=True)
class Polytope:
    """The points x with rows x <= limits, bounded; and one vertex of it, by the rows (F,) that meet there."""

    rows: Array
    limits: Array
    vertex: NDArray[np.int64]

    @staticmethod
    def of(rows: Array, limits: Array, directions: Array) -> Polytope:
        """Keep the rows that bound some of these directions (D, F), or their opposites."""
        optimum = linprog(-directions[0], A_ub=rows, b_ub=limits, bounds=(None, None), method="highs-ds")
        if optimum.status != 0:
            raise ValueError(f"the samples do not bound the models: {optimum.message}")
        last = np.argsort(limits - rows @ optimum.x)[: rows.shape[1]]
        bounding = last.copy()
        for direction in np.vstack([directions, -directions]):
            climb(rows, limits, direction, last)
            bounding = np.union1d(bounding, last)
        return Polytope(np.ascontiguousarray(rows[bounding]), limits[bounding], np.searchsorted(bounding, last))

    def supports(self, directions: Array) -> Array:
        """Return the largest p · x (D,) for the directions p (D, F)."""
        last = self.vertex.copy()
        values = np.array(
            [climb(self.rows, self.limits, direction, last) for direction in np.ascontiguousarray(directions)]
        )
        if not np.isfinite(values).all():
            raise ValueError("a linear program of consistent models has no solution")
        return values


@dataclass(frozen=True)
class ConsistentModels:
    """The constrained matrix zonotope, by output: the rows a with |y_t − a φ_t| <= size_t for all samples.

    Linear programs give its exact support; its generators and constraints would grow with the samples. Only the samples
    that matter in some recorded direction are left. Without the others, the set is slightly larger.

    Attributes:
        basis B (F, F): coordinates in which the samples φ are white.
        outputs: for each output j, the polytope of B⁻ᵀ (a − C_j).
    """

    C: Array
    box: Array
    basis: Array
    outputs: tuple[Polytope, ...]

    @staticmethod
    def fit(phi: Array, y: Array, sizes: Array) -> ConsistentModels:
        """Bound the consistent models. Samples that least squares do not fit within the noise are left out."""
        C, basis = least_squares(phi, y), whitening(phi)
        white, off = phi @ basis.T, y - phi @ C.T
        some = white[np.linspace(0, len(white) - 1, min(DIRECTIONS, len(white))).astype(int)]
        outputs = []
        for errors, size in zip(off.T, sizes.T, strict=True):
            consistent = np.abs(errors) <= size
            rows = np.vstack([white[consistent], -white[consistent]])
            limits = np.concatenate([size[consistent] + errors[consistent], size[consistent] - errors[consistent]])
            outputs.append(Polytope.of(rows, limits, np.vstack([some, basis.T])))
        box = [np.maximum(output.supports(basis.T), output.supports(-basis.T)) for output in outputs]
        return ConsistentModels(C, np.array(box), basis, tuple(outputs))

    def spread(self, phi: Array) -> tuple[Array, Array]:
        white = phi @ self.basis.T
        low, high = (np.stack([one.supports(sign * white) for one in self.outputs], axis=1) for sign in (-1.0, 1.0))
        return -low, high


def feature_box(features: Features, v: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Return a box of monomials as a linear part and a rest.

    Args:
        features: monomials, without saturating features.
        v, radius (T, v): centre and half-widths of the variables.

    Returns:
        φ at the centre (T, F); its first-order changes over each half-width (T, F, v); a bound of all others (T, F).
    """
    ones, zeros = np.ones((len(v), 1)), np.zeros((len(v), 1))
    center, half = np.hstack([ones, v / features.scale]), np.hstack([zeros, radius / features.scale])
    c, r = (np.moveaxis(p[:, features.terms], 2, 0) for p in (center, half))  # (4, T, F)
    linear = np.zeros((len(v), len(features.terms), center.shape[1]))
    sizes = np.zeros(c.shape[1:])
    for slot in range(features.terms.shape[1]):
        others = np.prod(np.delete(c, slot, axis=0), axis=0)
        linear[:, np.arange(len(features.terms)), features.terms[:, slot]] += r[slot] * others
        sizes += r[slot] * np.abs(others)
    rest = np.prod(np.abs(c) + r, axis=0) - np.abs(np.prod(c, axis=0)) - sizes
    return np.prod(c, axis=0), linear[..., 1:], np.maximum(rest, 0.0)


@dataclass(frozen=True)
class ModelTubes:
    """The tubes of a set of models: boxes of measured positions in the frame of the start.

    The measured next state lies in A φ ± noise, and poses are composed by the geometry that the one-step form uses.
    """

    robot: Robot
    features: Features
    models: Models
    noise: Noise

    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Return centres and half-widths (T, N, 2) for windows z (T, r + m + N·m)."""
        reg, m, count = len(self.robot.regressor), self.robot.action_dim, len(z)
        inputs = z[:, reg:].reshape(count, -1, m)
        s, radius = z[:, :reg], np.zeros((count, reg))
        p, around, heading, turned = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count), np.zeros(count)
        centers, halves = [], []
        for k in range(1, inputs.shape[1]):
            v = np.hstack([s, inputs[:, k], inputs[:, k - 1]])
            y, half = self._step(v, np.hstack([radius, np.zeros((count, 2 * m))]))
            cos, sin = np.cos(heading), np.sin(heading)
            R = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
            moved, aside = (np.einsum("tij,tj->ti", R, q) for q in (y[:, :2], y[:, 1::-1] * [-1.0, 1.0]))
            lengths = np.linalg.norm(y[:, :2], axis=1), np.linalg.norm(half[:, :2], axis=1)
            p = p + moved
            around = around + np.einsum("tij,tj->ti", np.abs(R), half[:, :2]) + np.abs(aside) * turned[:, None]
            around += (0.5 * turned**2 * lengths[0] + turned * lengths[1])[:, None]
            heading, turned = heading + y[:, 2], turned + half[:, 2]
            s, radius = y[:, 3:], half[:, 3:]
            centers.append(p)
            halves.append(around)
        return np.stack(centers, axis=1), np.stack(halves, axis=1)

    def _step(self, v: Array, radius: Array) -> tuple[Array, Array]:
        """Return centre and half-widths (T, n) of the outputs for boxes of variables."""
        phi, linear, rest = feature_box(self.features, v, radius)
        C, box = self.models.C, self.models.box
        low, high = self.models.spread(phi)
        half = (high - low) / 2.0 + self.noise.sizes(np.abs(v) + radius)
        half += np.abs(np.einsum("nf,tfv->tnv", C, linear)).sum(-1) + rest @ np.abs(C).T
        half += (np.abs(linear).sum(-1) + rest) @ box.T
        return phi @ C.T + (low + high) / 2.0, half
