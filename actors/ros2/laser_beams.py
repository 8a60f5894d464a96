"""Read a laser scan: what each of its ranges says about the space along its beam (REP 117).

    range                              what it says
    from range_min to range_max        free up to a hit
    inf                                free up to range_max
    -inf, and above 0 below range_min  something is too near to be measured
    NaN, 0, below 0, above range_max   nothing: REP 117 discards such a range

With `zero_is_free`, 0 says the same as inf. REP 117 also discards a range below range_min. It counts as a hit that is
too near here, since an obstacle at the body is the safer reading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.errors import BadScan
from brakeline.messaging.robot import Array
from brakeline.messaging.ros2.cdr_messages import LaserScan, seconds

MOST_BEAMS = 10_000
MORE_BEAMS = 2.5  # than a turn has: some drivers repeat the first beam at the end
END_ERROR = 2.5  # beams by which angle_max may be off: many drivers count one beam more or less


@dataclass(frozen=True)
class LaserBeams:
    """The n beams of a scan. A beam that is neither `known` nor `too_near` has no information."""

    times: Array  # (n,) s
    angles: Array  # (n,) rad, in the sensor's frame
    ranges: Array  # (n,) m of free space: up to the hit or the sensor's range; NaN for beams that are not `known`
    known: NDArray[np.bool_]  # (n,) whether the beam hit something, or nothing within the sensor's range
    too_near: NDArray[np.bool_]  # (n,) whether the beam hit something nearer than the sensor can measure
    gap: float  # rad between two neighbours
    farthest: float  # m, the sensor's range
    beyond: int = 0  # number of finite ranges above `farthest`

    def take(self, chosen: NDArray[np.bool_]) -> LaserBeams:
        """Return the chosen beams (a mask)."""
        times, angles, ranges = self.times[chosen], self.angles[chosen], self.ranges[chosen]
        known, too_near = self.known[chosen], self.too_near[chosen]
        return replace(self, times=times, angles=angles, ranges=ranges, known=known, too_near=too_near)


def read(scan: LaserScan, zero_is_free: bool = False) -> LaserBeams:
    """Return the beams of a scan. Raises BadScan: its angles or limits are not valid, or contradict each other.

    zero_is_free: the driver reports 0 where nothing is within range, as some do (REP 117 demands inf).
    """
    ranges = np.asarray(scan.ranges, dtype=float)
    n, gap = len(ranges), float(scan.angle_increment)
    limits = (scan.range_min, scan.range_max, scan.angle_min, scan.angle_max, gap, scan.time_increment)
    if not (2 <= n <= MOST_BEAMS and all(map(math.isfinite, limits)) and abs(gap) > 1.0 / MOST_BEAMS):
        raise BadScan(f"{n} beams, {gap:g} rad apart")
    if n * abs(gap) > 2.0 * math.pi + MORE_BEAMS * abs(gap):
        raise BadScan(f"{n} beams, {gap:g} rad apart, are more than a turn: are its angles in radians?")
    if not 0.0 <= scan.range_min < scan.range_max:
        raise BadScan(f"ranges from {scan.range_min:g} m to {scan.range_max:g} m")
    _check_end(scan, n, gap)
    times = seconds(scan.header.stamp) + float(scan.time_increment) * np.arange(n)
    angles = scan.angle_min + gap * np.arange(n)
    hit = (ranges >= scan.range_min) & (ranges <= scan.range_max) & (ranges > 0.0)  # NaN is neither
    free = np.isposinf(ranges)
    if zero_is_free:
        free |= ranges == 0.0
    too_near = ((ranges > 0.0) & (ranges < scan.range_min)) | np.isneginf(ranges)
    lengths = np.where(free, scan.range_max, np.where(hit, ranges, np.nan))
    beyond = int(np.count_nonzero((ranges > scan.range_max) & np.isfinite(ranges)))
    return LaserBeams(
        np.asarray(times, float),
        np.asarray(angles, float),
        lengths,
        hit | free,
        too_near,
        abs(gap),
        float(scan.range_max),
        beyond,
    )


def _check_end(scan: LaserScan, n: int, gap: float) -> None:
    """Refuse an angle_max that is not the direction of the last beam, or one near it."""
    last = scan.angle_min + gap * (n - 1)
    off = math.remainder(scan.angle_max - last, 2.0 * math.pi)
    if abs(off) > END_ERROR * abs(gap):
        raise BadScan(
            f"angle_max is {scan.angle_max:.4g} rad, but {n} beams from {scan.angle_min:.4g} rad on, {gap:.4g} rad "
            f"apart, end at {last:.4g} rad: one of these numbers is wrong, so nobody knows where the beams point"
        )
