"""Which beams of a scan ended on what stands still, though other things move: on what is straight for long.

People, robots and other discs are round and small: in a window of beams whose ends are `over` apart or more, with hits
so close together that nothing fits between them, the ends lie on a straight line, within the error of a range, only if
they lie on a wall or on the side of a large box. Whoever tracks what it sees may say more (`Scan.still`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from messaging.scans import Scan

Array = NDArray[np.float64]

WINDOWS = (6, 9, 13, 19, 28, 42, 63, 94)  # beams
ROUGH = 0.005  # m, of a straight side
SHORTEST, LONGEST = 1.0, 2.0  # of a window, in `over`


def straight(scan: Scan, over: float) -> NDArray[np.bool_]:
    """(R,): beams that ended on what is straight over so many m."""
    count = len(scan.ranges)
    hit = scan.known & (scan.ranges < scan.far)
    ends = scan.ranges[:, None] * np.column_stack([np.cos(scan.angles), np.sin(scan.angles)])
    ends, hit = np.concatenate([ends, ends]), np.concatenate([hit, hit])  # windows go round
    step = np.diff(ends, axis=0)
    loose = ~(hit[1:] & hit[:-1] & (np.einsum("bd,bd->b", step, step) <= scan.least_width**2))
    loose = np.concatenate([[0], np.cumsum(loose)])
    x, y = ends.T
    sums = np.cumsum(np.column_stack([x, y, x * x, y * y, x * y]), axis=0)
    sums = np.concatenate([np.zeros((1, 5)), sums])
    marks = np.zeros(2 * count + 1)
    for size in WINDOWS:
        if size > count:
            break
        first = np.arange(2 * count - size + 1)
        last = first + size - 1
        across = ends[last] - ends[first]
        length = np.einsum("bd,bd->b", across, across)
        fits = (length >= (SHORTEST * over) ** 2) & (length <= (LONGEST * over) ** 2) & (loose[last] == loose[first])
        found = first[fits]
        mx, my, xx, yy, xy = ((sums[found + size] - sums[found]) / size).T
        a, c, b = xx - mx * mx, yy - my * my, xy - mx * my
        off = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)  # mean square beside the line that fits best
        found = found[off <= (scan.range_error + ROUGH) ** 2]
        np.add.at(marks, found, 1.0)
        np.add.at(marks, found + size, -1.0)
    inside = np.cumsum(marks)[:-1] > 0.0
    return np.asarray(inside[:count] | inside[count:])
