"""Zonotopes: the sets that reachability computes with."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Zonotope:
    """`{ c + G b : -1 <= b_i <= 1 }` with center c (n,) and generators G (n, g) as columns (paper, definition 1)."""

    center: Array
    generators: Array

    def __post_init__(self) -> None:
        if self.center.ndim != 1 or self.generators.ndim != 2 or len(self.generators) != len(self.center):
            raise ValueError(f"center {self.center.shape} and generators {self.generators.shape} do not fit")

    @staticmethod
    def box(center: Array, half_width: Array) -> Zonotope:
        """The box with these half-widths: one generator an axis (a single generator of ones is a line segment)."""
        return Zonotope(np.asarray(center, float), np.diag(np.asarray(half_width, float)))

    @property
    def dim(self) -> int:
        return len(self.center)

    def map(self, matrix: Array) -> Zonotope:
        """`{ L z }`, exactly."""
        return Zonotope(matrix @ self.center, matrix @ self.generators)

    def __add__(self, other: Zonotope) -> Zonotope:
        """Minkowski sum, exactly (paper, equation 1)."""
        return Zonotope(self.center + other.center, np.hstack([self.generators, other.generators]))

    def product(self, other: Zonotope) -> Zonotope:
        """Cartesian product, exactly (paper, equation 2)."""
        generators = np.zeros((self.dim + other.dim, self.generators.shape[1] + other.generators.shape[1]))
        generators[: self.dim, : self.generators.shape[1]] = self.generators
        generators[self.dim :, self.generators.shape[1] :] = other.generators
        return Zonotope(np.concatenate([self.center, other.center]), generators)

    def support(self, direction: Array) -> Array:
        """`max a·z` over the set, for directions (..., n): (...)."""
        return np.asarray(direction @ self.center + np.abs(direction @ self.generators).sum(-1))

    def hull(self) -> tuple[Array, Array]:
        """Lower and upper corner of the interval hull."""
        half = np.abs(self.generators).sum(1)
        return self.center - half, self.center + half

    def norm(self, point: Array) -> float:
        """Smallest s with `point` in `c + s (Z - c)`, by one LP; inf outside the generators' span."""
        from scipy.optimize import linprog  # half a second, and nothing that a service needs

        n, count = self.generators.shape
        cost = np.append(np.zeros(count), 1.0)
        equal = np.hstack([self.generators, np.zeros((n, 1))])
        ones = np.ones((count, 1))
        bound = np.vstack([np.hstack([np.eye(count), -ones]), np.hstack([-np.eye(count), -ones])])
        free = [(None, None)] * count + [(0, None)]
        found = linprog(cost, A_ub=bound, b_ub=np.zeros(2 * count), A_eq=equal, b_eq=point - self.center, bounds=free)
        return float(found.fun) if found.status == 0 else float("inf")

    def contains(self, point: Array, tolerance: float = 1e-9) -> bool:
        return self.norm(point) <= 1.0 + tolerance

    def volume(self) -> float:
        """`2^n Σ |det|` over all choices of n generators."""
        n, count = self.generators.shape
        choices = combinations(range(count), n)
        return float(2**n * sum(abs(np.linalg.det(self.generators[:, list(choice)])) for choice in choices))

    def reduce(self, order: float) -> Zonotope:
        """A zonotope of at most `order * dim` generators that contains this one (Girard's method)."""
        n, count = self.generators.shape
        keep = int(order * n) - n
        if count <= keep + n:
            return self
        if keep < 0:
            raise ValueError(f"a reduction below order 1 ({order}) is not possible")
        size = np.abs(self.generators).sum(0) - np.abs(self.generators).max(0)
        rank = np.argsort(size)[::-1]
        box = np.diag(np.abs(self.generators[:, rank[keep:]]).sum(1))
        return Zonotope(self.center, np.hstack([self.generators[:, rank[:keep]], box]))


def facet_normals(generators: Array) -> Array:
    """Normals of all facets of a full-dimensional zonotope with these generators (n, g), n <= 3: (facets, n).

    A point lies in the set exactly if it passes the support test in these directions and their opposites.
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
