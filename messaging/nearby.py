"""The least of all beams nearby, compiled (`patches.least_within`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messaging.compiled import compiled

Array = NDArray[np.float64]


@compiled("f8[:,::1](f8[:,::1], i8, i8[::1])")
def least_of(values: Array, rows: int, beside: NDArray[np.int64]) -> Array:
    """Of a grid (E, A), round in its columns: the least (E, A) of so many rows above and below each, and so many
    columns (E,) beside it."""
    rings, columns = values.shape
    found, upright, wrapped = np.empty((rings, columns)), np.empty(columns), np.empty(2 * columns)
    for i in range(rings):
        upright[:] = values[max(i - rows, 0)]
        for k in range(max(i - rows, 0) + 1, min(i + rows, rings - 1) + 1):
            for j in range(columns):
                upright[j] = min(upright[j], values[k, j])
        count = 2 * beside[i] + 1
        if count >= columns:
            found[i] = upright.min()
            continue
        length = columns + count - 1
        wrapped[: beside[i]] = upright[columns - beside[i] :]
        wrapped[beside[i] : beside[i] + columns] = upright
        wrapped[beside[i] + columns : length] = upright[: beside[i]]
        width = 1  # of what each entry is the least
        while 2 * width <= count:
            length -= width
            for j in range(length):
                wrapped[j] = min(wrapped[j], wrapped[j + width])
            width *= 2
        for j in range(columns):
            found[i, j] = min(wrapped[j], wrapped[j + count - width])
    return found
