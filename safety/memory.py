"""What a robot's sensor saw free before: fills in the beams of a scan that say nothing (method §10).

The asker keeps it: the service keeps nothing about a robot. A world that moves (`Scan.speed`) takes back with time what
was seen. Where the robot was put there is room: `START` m about its body; without that it could never move away from a
blind sector, for it would touch it already.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from messaging.scans import Scan
from safety.scan import gaps

Array = NDArray[np.float64]

START = 0.1  # m beside the body, where it is put down
KEPT = 12  # scans
APART = 0.04  # m or, by a quarter of it, rad, between two that are kept
LOOK = 1.0  # m along a beam that memory is asked about
STEP = 0.01  # m between the places at which it is
CELLS = 360  # of a turn


@dataclass(frozen=True)
class _Seen:
    """A scan as the free range of every direction: least[k] (CELLS,) over 2^k of them from each on."""

    scan: Scan
    at: Array
    heading: float
    least: list[Array]


class Memory:
    """Of one robot in one world that is not put back. Positions are the measured ones, with their errors."""

    def __init__(self, footprint: float) -> None:
        """footprint: radius of the body's disc, m."""
        self._room = footprint + START
        self.reset()

    def reset(self) -> None:
        """It is put down somewhere else."""
        self._seen: deque[_Seen] = deque(maxlen=KEPT)
        self._put: tuple[float, float, float] | None = None
        self._age = 0.0  # s since it was put down
        self._before: list[float] = []  # s since each scan was taken

    def fill(self, scan: Scan, elapsed: float) -> Scan:
        """The scan, with what is remembered in the place of beams that say nothing; elapsed: s since the last one."""
        if self._put is None:
            self._put = scan.pose
        else:
            self._age += elapsed
            self._before = [age + elapsed for age in self._before]
        unknown = ~scan.known
        filled = scan
        if unknown.any():
            ranges = np.array(scan.ranges)
            ranges[unknown] = self._along(scan, scan.angles[unknown])
            filled = replace(scan, ranges=ranges)
        self._keep(scan)
        return filled

    def _keep(self, scan: Scan) -> None:
        if self._seen:
            last = self._seen[-1].scan.pose
            moved = math.dist(last[:2], scan.pose[:2]) + 0.25 * abs(math.remainder(scan.pose[2] - last[2], math.tau))
            if moved < APART:
                return
        if len(self._seen) == KEPT:
            self._before.pop(0)
        at, heading = scan.sensor()
        self._seen.append(_Seen(scan, at, heading, _levels(_least(scan))))
        self._before.append(scan.age)

    def _along(self, scan: Scan, angles: Array) -> Array:
        """How far these beams (B,) are known to be free, m; 0: not at all."""
        at, heading = scan.sensor()
        away = STEP * np.arange(1, round(LOOK / STEP) + 1)
        turned = heading + angles
        points = at + away[:, None, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)  # (S, B, 2)
        free = self._at_start(points, scan)
        for seen, age in zip(self._seen, self._before, strict=True):
            free |= self._in(seen, age, points, scan)
        steps = np.where(free.all(axis=0), len(away), free.argmin(axis=0))
        known = STEP * steps
        # `gaps` takes the range's error off every beam: what is remembered has its errors off already
        return np.where(steps > 0, np.minimum(known + scan.range_error, scan.far), 0.0)

    def _at_start(self, points: Array, scan: Scan) -> NDArray[np.bool_]:
        """In the room that it was put down in?"""
        assert self._put is not None
        drift = 2.0 * scan.position_error * (scan.pose != self._put) + scan.speed * self._age + STEP
        return np.asarray(np.linalg.norm(points - np.array(self._put[:2]), axis=-1) <= self._room - drift)

    def _in(self, seen: _Seen, age: float, points: Array, scan: Scan) -> NDArray[np.bool_]:
        """Was it seen free, with all that is within the errors since?"""
        away = points - seen.at
        far = np.sqrt(np.einsum("sbd,sbd->sb", away, away))
        drift = seen.scan.position_error + scan.position_error + scan.speed * age + STEP
        drift = drift + (seen.scan.heading_error + scan.heading_error) * far
        aside = np.arcsin(np.minimum(drift / np.maximum(far, 1e-9), 1.0))
        angle = np.arctan2(away[..., 1], away[..., 0]) - seen.heading
        first = np.floor((angle - aside) * (CELLS / math.tau)).astype(int)
        last = np.floor((angle + aside) * (CELLS / math.tau)).astype(int)
        count = np.where(drift >= far, CELLS, np.minimum(last - first + 1, CELLS))
        level = np.floor(np.log2(count)).astype(int)
        table = np.stack(seen.least)
        low = table[level, first % CELLS]
        high = table[level, (first + count - (1 << level)) % CELLS]
        return np.asarray(far + drift < np.minimum(low, high))


def _least(scan: Scan) -> Array:
    """The least free range (CELLS,) of the gaps that meet each of so many equal parts of a turn, from heading 0 on."""
    angles, width, free = gaps(scan)
    least = np.full(CELLS, np.inf)
    first = np.floor(angles * (CELLS / math.tau) - 1e-9).astype(int)
    last = np.floor((angles + width) * (CELLS / math.tau) + 1e-9).astype(int)
    for step in range(int((last - first).max()) + 1):
        within = first + step <= last
        np.minimum.at(least, (first[within] + step) % CELLS, free[within])
    return least


def _levels(least: Array) -> list[Array]:
    """least[k][i]: the least of 2^k values from i on, round the turn."""
    found = [least]
    while 1 << len(found) <= CELLS:
        half = 1 << (len(found) - 1)
        found.append(np.minimum(found[-1], np.roll(found[-1], -half)))
    return found
