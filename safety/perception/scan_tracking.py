"""What scans one after the other tell of where whatever was hit goes: what stood, and what moved how fast.

Of one scan all that is known is a bound on the speed of everything (`Scan.speed`). Surfaces that are where they were in
the scans before go on from standing, no faster than the bound on the acceleration lets them: in time t by

    v t + a t²/2,    v = min over the earlier scans, τ ago, of (ε + a τ²/2) / τ

with ε by how much a surface may have moved and still seem to be where it was. What stands apart and is as large as
somebody is taken for the same as what was near its place before; its velocity is that of its middle, and v comes of the
middle's error. All else goes on as fast as anything may: what is new, half hidden, or too near to something else.

The asker keeps it, as it keeps its memory (`safety/perception/visibility_memory.py`): the service keeps nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.scan import BeamTracks, Scan

Array = NDArray[np.float64]

KEPT = 3  # scans
FEWEST = 2  # earlier scans that say that something stands
SAME = 0.05  # m: what was measured to be as near to an earlier surface may be that
MOVED = 0.08  # m, ε
BESIDE = 3  # beams to either side of a direction, between which the surface there is looked for
LINK = 0.15  # m between two beams' hits on one surface; something apart is as far before what is beside it
LARGEST = 0.8  # m from end to end of what may be somebody
LEAST_BEAMS = 4  # on it
MIDDLE = 0.03  # m, how wrong the middle of somebody may be
SPAN = 0.3  # s, at least, between two places that a velocity is made of; and at most since the last scan


@dataclass(frozen=True)
class _Seen:
    """Of one scan: at (2,), heading: the sensor's place; beams (k,) that hit something, ascending; their angles (k,) in
    the sensor's frame, rad; points (k, 2); linked (k,): one surface with the next one; groups: of what stands apart,
    which of the k hit it, and middles (g, 2) of that."""

    at: Array
    heading: float
    beams: NDArray[np.intp]
    angles: Array
    points: Array
    linked: NDArray[np.bool_]
    middles: Array
    groups: list[NDArray[np.intp]]


class ScanTracker:
    """Of one robot in one world that is not put back."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """It is put down somewhere else."""
        self._before: deque[tuple[float, _Seen]] = deque(maxlen=KEPT)  # s since it was taken; the latest last

    def later(self, elapsed: float) -> None:
        """So many s go by."""
        self._before = deque([(age + elapsed, seen) for age, seen in self._before], maxlen=KEPT)

    def follow(self, scan: Scan) -> Scan:
        """The scan, with what those before say of it; as it is where nothing bounds how things speed up."""
        if scan.speed <= 0.0 or scan.acceleration <= 0.0:
            return scan
        seen = _seen(scan)
        before = [(age - scan.age, other) for age, other in self._before if age > scan.age]
        which, ways = np.zeros(len(scan.ranges), dtype=np.uint8), list[tuple[float, ...]]()
        for group, way in self._moving(scan, seen, before):
            ways.append(way)
            which[seen.beams[group]] = len(ways)
        if len(before) >= FEWEST:
            still = np.logical_and.reduce([_near(seen, other) <= SAME for _, other in before])
            ways.append((0.0, 0.0, min(_speed(MOVED, age, scan) for age, _ in before), scan.acceleration))
            which[seen.beams[still]] = len(ways)
        self._before.append((scan.age, seen))
        return replace(scan, tracks=BeamTracks(which, np.array(ways, dtype=float).reshape(-1, 4)))

    def _moving(
        self, scan: Scan, seen: _Seen, before: list[tuple[float, _Seen]]
    ) -> list[tuple[NDArray[np.intp], tuple[float, ...]]]:
        """What stands apart and was followed from place to place, and its ways. Nobody is where a scan is missing, or
        beams may see through: somebody else's place may then seem to be his."""
        if len(before) < FEWEST or before[-2][0] < SPAN or before[-1][0] > SPAN or scan.doubt > 0:
            return []
        (short, last), (long, first) = before[-1], before[-2]
        error = _speed(2.0 * MIDDLE, long, scan)
        found: list[tuple[NDArray[np.intp], tuple[float, ...]]] = []
        for group, middle in zip(seen.groups, seen.middles, strict=True):
            one = _only(last.middles, middle, scan.speed * short + 2.0 * MIDDLE)
            other = None if one is None else _only(first.middles, one, scan.speed * (long - short) + 2.0 * MIDDLE)
            if one is None or other is None:
                continue
            velocity = (middle - other) / long
            turned = float(np.linalg.norm((middle - one) / short - velocity))
            steady = turned <= 0.5 * scan.acceleration * long + 2.0 * MIDDLE / short + 2.0 * MIDDLE / long
            if steady and float(np.linalg.norm(velocity)) <= scan.speed + error:
                found.append((group, (float(velocity[0]), float(velocity[1]), error, scan.acceleration)))
        return found


def _speed(moved: float, age: float, scan: Scan) -> float:
    """m/s: how fast may be what moved by so much since then?"""
    return (moved + 0.5 * scan.acceleration * age * age) / age


def _only(places: Array, there: Array, within: float) -> Array | None:
    """The one of the places (g, 2) within so many m of there; None: none is, or several are."""
    near = np.flatnonzero(np.linalg.norm(places - there, axis=1) <= within)
    return places[near[0]] if len(near) == 1 else None


def _seen(scan: Scan) -> _Seen:
    at, heading = scan.sensor()
    ranges = np.where(scan.known, scan.ranges, 0.0)
    beams = np.flatnonzero(scan.known & (ranges < scan.far))
    angles = scan.angles[beams]
    away = ranges[beams]
    points = at + away[:, None] * np.column_stack([np.cos(heading + angles), np.sin(heading + angles)])
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    apart = (np.roll(beams, -1) - beams) % len(ranges)
    linked = (step <= LINK) & (apart == 1)
    groups = _groups(scan, ranges, beams, points, linked)
    middles = np.array([points[group].mean(axis=0) for group in groups], dtype=float).reshape(-1, 2)
    return _Seen(at, heading, beams, angles, points, linked, middles, groups)


def _groups(
    scan: Scan, ranges: Array, beams: NDArray[np.intp], points: Array, linked: NDArray[np.bool_]
) -> list[NDArray[np.intp]]:
    """What stands apart: runs of linked hits, before what is seen on both sides of it."""
    ends = np.flatnonzero(~linked)
    found = []
    for i, end in enumerate(ends):
        begin = ends[i - 1] + 1 - (len(beams) if i == 0 else 0)
        run = np.arange(begin, end + 1)
        if not LEAST_BEAMS <= len(run) < len(beams):
            continue
        beside = ranges[(beams[run[0]] - 1) % len(ranges)], ranges[(beams[end] + 1) % len(ranges)]
        whole = beside[0] > ranges[beams[run[0]]] + LINK and beside[1] > ranges[beams[end]] + LINK
        if whole and float(np.linalg.norm(points[run[0]] - points[end])) <= LARGEST:
            found.append(run)
    return found


def _near(seen: _Seen, other: _Seen) -> Array:
    """How near [m] each hit (k,) is to the surface that another scan met about where it is."""
    count = len(other.beams)
    if not count:
        return np.full(len(seen.beams), np.inf)
    away = seen.points - other.at
    turn = np.arctan2(away[:, 1], away[:, 0]) - other.heading - other.angles[0]
    first = np.searchsorted(other.angles, other.angles[0] + np.mod(turn, 2.0 * np.pi))
    begin = (first[:, None] + np.arange(-BESIDE, BESIDE)) % count
    start = other.points[begin]  # (k, 2·BESIDE, 2)
    along = np.where(other.linked[begin][..., None], other.points[(begin + 1) % count] - start, 0.0)
    square = np.maximum(np.einsum("kbd,kbd->kb", along, along), 1e-12)
    off = seen.points[:, None] - start
    share = np.clip(np.einsum("kbd,kbd->kb", off, along) / square, 0.0, 1.0)
    off -= share[..., None] * along
    return np.asarray(np.sqrt(np.einsum("kbd,kbd->kb", off, off).min(axis=1)))
