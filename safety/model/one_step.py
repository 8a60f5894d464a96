"""Predict one period from data, and roll the prediction out over a plan (docs/method.md §13).

A robot that drives and turns moves by the product of speed and turn rate. A map that is linear in the inputs cannot
represent this product, so its error bound must cover it. Here, one learned period is composed by geometry that holds
exactly:

    [Δp; Δθ; s⁺] = C φ(s, u, u₋)        p ← p + R(θ) Δp,   θ ← θ + Δθ,   s ← s⁺
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadModel
from brakeline.messaging.robot import Array, Robot

Index = NDArray[np.int64]
Predictor = tuple[Array, Array, Array, Index, Index, int, Array, int, int]

TENSOR = "one_step."  # prefix of the names in a file
FACTORS = 4  # of a feature, at most
WIDTHS = (0.2, 0.5)  # of saturating features, as shares of the largest recorded difference of input and speed
SIGN = 0.05  # width of the smooth sign of a speed, as a share of the largest recorded speed


@dataclass(frozen=True)
class Features:
    """The features φ of one period: products of up to four primitives (see `rollout_kernels`).

    Attributes:
        scale (v,): units of the variables v = [s; u; input of the period before].
        saturations (E, 3): [a, b, width] of each primitive tanh((v_a - v_b) / width), with b = -1 for no v_b.
        terms (F, 4): indices of the primitives in each product. Index 0 is the constant 1. Files of earlier
            versions have products of three (F, 3).
    """

    scale: Array
    saturations: Array
    terms: Index

    def __call__(self, v: Array) -> Array:
        """Return the features (T, F) of variables v (T, v)."""
        columns = [np.ones(len(v)), *(v / self.scale).T]
        for a, b, width in self.saturations:
            columns.append(np.tanh((v[:, int(a)] - (v[:, int(b)] if b >= 0 else 0.0)) / width))
        p, (first, *others) = np.stack(columns), self.terms.T
        products = p[first]
        for factor in others:
            more = np.flatnonzero(factor)  # the other factors are the constant 1
            products[more] *= p[factor[more]]
        return np.asarray(products.T)

    def subset(self, used: Index) -> Features:
        """Return the features with these indices."""
        return replace(self, terms=self.terms[used])


def features_for(robot: Robot, v: Array, degree: int, lags: int) -> Features:
    """Return the features from which the fit selects.

    These are all monomials up to a degree, and two kinds of features that monomials cannot represent:

    - the tanh of the difference of an input and the speed that follows it: so an autopilot that limits its acceleration
      answers;
    - the absolute value of a speed, |s| = s · sign s, alone or times one more variable: slip and drag depend on it.

    Args:
        robot: the robot.
        v (T, v): recorded variables. They set the scales.
        degree: the highest degree of the monomials, 1 to 4.
        lags: 1 to use the input of the period before, 0 to leave it out.
    """
    measured = len(robot.regressor)
    count = measured + robot.action_dim * (1 + lags)
    scale = np.abs(v).max(0)
    scale[scale <= 0.0] = 1.0
    rows: list[tuple[float, float, float]] = []
    for i, index in enumerate(robot.follows):
        if index in robot.regressor:
            a, b = measured + i, robot.regressor.index(index)
            most = float(np.abs(v[:, a] - v[:, b]).max())
            rows += [(a, b, share * most) for share in WIDTHS if most > 0.0]
    first = 1 + v.shape[1]  # index of the first saturation
    bent: list[tuple[int, ...]] = [(first + e,) for e in range(len(rows))]
    for a in range(measured):
        sign = first + len(rows)
        rows.append((a, -1.0, SIGN * float(scale[a])))
        bent += [(1 + a, sign), *((1 + a, other, sign) for other in range(1, count + 1) if degree > 1)]
    products = [c for n in range(degree + 1) for c in combinations_with_replacement(range(1, count + 1), n)]
    terms = [(*c, *(0,) * (FACTORS - len(c))) for c in (*products, *bent)]
    return Features(scale, np.array(rows).reshape(-1, 3), np.array(terms, dtype=np.int64))


@dataclass(frozen=True)
class OneStep:
    """The predictor of one period.

    Attributes:
        C (n, F): outputs from features: displacement and change of heading in the robot's own frame, and the other
            coordinates after the period.
        features: φ.
        root (F, F): inverse of the lower Cholesky factor of the features' second moment in the data.
        weight: how much the sets grow with the leverage of a plan (docs/method.md §14).
        start: factor on all sets of plans within a plan's length of an episode's start, at least 1. There a robot's
            estimate of its state is often worse than later.
    """

    C: Array
    features: Features
    root: Array
    weight: float = 0.0
    start: float = 1.0

    def tensors(self) -> dict[str, Array]:
        """Return the arrays of the predictor by their names in a model set's file."""
        f = self.features
        named = {"C": self.C, "scale": f.scale, "saturations": f.saturations, "terms": f.terms.astype(float)}
        named |= {"root": self.root, "weight": np.array([self.weight])}
        if self.start != 1.0:  # files of earlier versions have none, and a version is a hash of the content
            named["start"] = np.array([self.start])
        return {TENSOR + name: value for name, value in named.items()}

    @staticmethod
    def of_tensors(tensors: dict[str, Array]) -> OneStep:
        """Return the predictor that a model set's file holds; KeyError without one."""
        names = "C", "scale", "saturations", "terms", "root", "weight"
        C, scale, saturations, terms, root, weight = (tensors[TENSOR + name] for name in names)
        start = float(tensors[TENSOR + "start"][0]) if TENSOR + "start" in tensors else 1.0
        return OneStep(C, Features(scale, saturations, terms.astype(np.int64)), root, float(weight[0]), start)

    def check(self, robot: Robot) -> None:
        """Check the sizes and indices of a predictor that comes from a file.

        Raises:
            BadModel: an array does not fit the robot, or an index is out of range.
        """
        f, variables = self.features, len(robot.regressor) + 2 * robot.action_dim
        primitives = 1 + variables + len(f.saturations)
        good = f.scale.shape == (variables,) and (f.scale > 0.0).all() and f.saturations.ndim == 2
        good = good and f.terms.ndim == 2 and f.terms.shape[1] in (3, FACTORS) and f.saturations.shape[1] == 3
        good = good and self.C.shape == (robot.state_dim, len(f.terms)) and len(f.terms) > 0
        good = good and f.terms.min() >= 0 and f.terms.max() < primitives
        pairs, widths = f.saturations[:, :2], f.saturations[:, 2]
        good = good and bool((pairs >= [0, -1]).all() and (pairs < variables).all() and (widths > 0.0).all())
        if not good or self.root.shape != (len(f.terms),) * 2 or not (self.weight >= 0.0 and self.start >= 1.0):
            raise BadModel(f"the predictor of one period does not fit {robot.name}")

    def rollouts(self, robot: Robot, z: Array) -> Array:
        """Return the outputs (T, N, n + d·discs) for windows z (T, r + m + N·m), as `predicted_outputs` has them."""
        return replace(self, weight=0.0).rollouts_with_stretch(robot, z)[0]

    def stretches(self, robot: Robot, z: Array) -> Array:
        """Return the factors sqrt(1 + weight · leverage) on the sets (T, N) of windows z (T, r + m + N·m)."""
        return self.rollouts_with_stretch(robot, z)[1]

    def rollouts_with_stretch(self, robot: Robot, z: Array) -> tuple[Array, Array]:
        """Return what `rollouts` and `stretches` return, in less time than both."""
        return self._rolled(robot, z, 0)

    def last_stretches(self, robot: Robot, z: Array) -> Array:
        """Return the factors (T,) on the last sets of windows z (T, r + m + N·m), in less time than all of them."""
        return self.rollouts_with_last_stretch(robot, z)[1]

    def rollouts_with_last_stretch(self, robot: Robot, z: Array) -> tuple[Array, Array]:
        """Return what `rollouts` and `last_stretches` return."""
        outputs, stretches = self._rolled(robot, z, robot.horizon - 1)
        return outputs, stretches[:, -1]

    def _rolled(self, robot: Robot, z: Array, first: int) -> tuple[Array, Array]:
        """first: number of the first period whose stretch is computed."""
        from brakeline.safety.filter.kernels import window_rollout_kernels

        whole = np.ascontiguousarray
        return window_rollout_kernels.rollouts(self.arguments(robot), whole(self.root), self.weight, whole(z), first)

    def arguments(self, robot: Robot) -> Predictor:
        """Return the first argument of the kernels, which is the same for every plan: the predictor and its robot."""
        f, d = self.features, robot.position_dim
        heading = -1 if robot.heading is None else robot.heading
        arms = [disc.at for disc in robot.body if disc.arm > 0.0 and heading >= 0]
        others, centers = np.array(robot.regressor, dtype=np.int64), np.array(arms, dtype=float).reshape(len(arms), d)
        whole = np.ascontiguousarray
        terms = np.pad(f.terms, ((0, 0), (0, FACTORS - f.terms.shape[1])))  # with the constant 1
        predictor = whole(self.C), whole(f.scale), whole(f.saturations), whole(terms)
        return *predictor, others, heading, centers, d, robot.action_dim

    def rollout_arguments(self, robot: Robot) -> tuple[Predictor, Array, float]:
        """Return the first arguments of the kernels that roll out one plan: also the transposed root, and the weight.

        The root is transposed here, so that the kernel's inner loop runs along memory.
        """
        return self.arguments(robot), np.ascontiguousarray(self.root.T), self.weight
