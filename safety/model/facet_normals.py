"""The facets of a zonotope, to check whether a point lies in it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
