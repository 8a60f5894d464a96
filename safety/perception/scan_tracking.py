"""Track surfaces from scan to scan: which stood, and which moved how fast (docs/method.md §10).

A single scan bounds the speed of everything by `Scan.speed`. A surface that earlier scans saw at the same place starts
from standing, no faster than the bound a on the acceleration allows. In time t it moves at most

    v t + a t²/2,    v = min over the earlier scans, τ ago, of (ε + a τ²/2) / τ,

with ε the distance that a surface may have moved and still seem to be at the same place. A group of hits that stands
apart and is as large as a person is matched to the one group near its place before. Its velocity is that of its
center, and v comes from the center's error. Everything else may move at the largest speed: what is new, half hidden, or
too close to something else.

The client keeps the tracker with its memory (`visibility_memory.py`), because the service keeps nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array
from brakeline.messaging.scan import BeamTracks, Scan
from brakeline.safety.perception.scan_coverage import hits_of

CAPACITY = 3  # scans
FEWEST = 2  # earlier scans that must show a surface to stand
SAME = 0.05  # m: a hit this close to an earlier surface may be on it
MOVED = 0.08  # m, ε
NEIGHBOURS = 3  # beams to either side of a direction that may have hit the surface there
LINK = 0.15  # m between two hits on one surface, at most; a group stands apart if its neighbours are farther by as much
LARGEST = 0.8  # m from end to end of a group
LEAST_BEAMS = 4  # of a group
CENTER_ERROR = 0.03  # m: largest error of a group's center
SPAN = 0.3  # s: least time between two positions of a velocity, and largest time since the last scan


@dataclass(frozen=True)
class _Hits:
    """The hits of one scan."""

    # at, heading: pose of the sensor
    at: Array
    heading: float
    beams: NDArray[np.intp]  # (k,) numbers of the beams that hit something, ascending
    angles: Array  # (k,) of these beams in the sensor's frame [rad]
    points: Array  # (k, 2) hits [m], world
    linked: NDArray[np.bool_]  # (k,) whether a hit is on one surface with the next one
    centers: Array  # (g, 2) of the groups that stand apart [m]
    groups: list[NDArray[np.intp]]  # the indices of each group's hits


class ScanTracker:
    """Tracks what one robot's scans show, in one episode."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._before: deque[tuple[float, _Hits]] = deque(maxlen=CAPACITY)  # ages [s] and hits, the latest last

    def later(self, elapsed: float) -> None:
        """Let time pass [s]."""
        self._before = deque([(age + elapsed, hits) for age, hits in self._before], maxlen=CAPACITY)

    def follow(self, scan: Scan) -> Scan:
        """Return the scan with the motions of its surfaces, or unchanged if no acceleration bound is known."""
        if scan.speed <= 0.0 or scan.acceleration <= 0.0:
            return scan
        hits = _hits(scan)
        before = [(age - scan.age, other) for age, other in self._before if age > scan.age]
        which, ways = np.zeros(len(scan.ranges), dtype=np.uint8), list[tuple[float, ...]]()
        for group, way in self._moving(scan, hits, before):
            ways.append(way)
            which[hits.beams[group]] = len(ways)
        if len(before) >= FEWEST:
            still = np.logical_and.reduce([_distance_to(hits, other) <= SAME for _, other in before])
            ways.append((0.0, 0.0, min(_speed(MOVED, age, scan) for age, _ in before), scan.acceleration))
            which[hits.beams[still]] = len(ways)
        self._before.append((scan.age, hits))
        return replace(scan, tracks=BeamTracks(which, np.array(ways, dtype=float).reshape(-1, 4)))

    def _moving(
        self, scan: Scan, hits: _Hits, before: list[tuple[float, _Hits]]
    ) -> list[tuple[NDArray[np.intp], tuple[float, ...]]]:
        """Return the groups that were matched through three scans, and their motions.

        There are none if a scan is missing or beams are doubted: a group could then be matched to another's place.
        """
        if len(before) < FEWEST or before[-2][0] < SPAN or before[-1][0] > SPAN or scan.doubt > 0:
            return []
        (short, last), (long, first) = before[-1], before[-2]
        error = _speed(2.0 * CENTER_ERROR, long, scan)
        moving: list[tuple[NDArray[np.intp], tuple[float, ...]]] = []
        for group, center in zip(hits.groups, hits.centers, strict=True):
            one = _only_one(last.centers, center, scan.speed * short + 2.0 * CENTER_ERROR)
            if one is None:
                continue
            other = _only_one(first.centers, one, scan.speed * (long - short) + 2.0 * CENTER_ERROR)
            if other is None:
                continue
            velocity = (center - other) / long
            turned = float(np.linalg.norm((center - one) / short - velocity))
            allowed = 0.5 * scan.acceleration * long + 2.0 * CENTER_ERROR / short + 2.0 * CENTER_ERROR / long
            if turned <= allowed and float(np.linalg.norm(velocity)) <= scan.speed + error:
                moving.append((group, (float(velocity[0]), float(velocity[1]), error, scan.acceleration)))
        return moving


def _speed(moved: float, age: float, scan: Scan) -> float:
    """Return the largest speed [m/s] now of something that has moved by a distance [m] in the last `age` s."""
    return (moved + 0.5 * scan.acceleration * age * age) / age


def _only_one(centers: Array, position: Array, within: float) -> Array | None:
    """Return the one center (g, 2) within a distance [m] of a position, or None if there is none or several."""
    near = np.flatnonzero(np.linalg.norm(centers - position, axis=1) <= within)
    return centers[near[0]] if len(near) == 1 else None


def _hits(scan: Scan) -> _Hits:
    ranges = np.where(scan.valid_beams, scan.ranges, 0.0)
    beams, points = hits_of(scan)
    step = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    apart = (np.roll(beams, -1) - beams) % len(ranges)
    linked = (step <= LINK) & (apart == 1)
    groups = _groups(scan, ranges, beams, points, linked)
    centers = np.array([points[group].mean(axis=0) for group in groups], dtype=float).reshape(-1, 2)
    return _Hits(*scan.sensor(), beams, scan.angles[beams], points, linked, centers, groups)


def _groups(
    scan: Scan, ranges: Array, beams: NDArray[np.intp], points: Array, linked: NDArray[np.bool_]
) -> list[NDArray[np.intp]]:
    """Return the hits of each group that stands apart: a run of linked hits in front of what is on both sides of it."""
    ends = np.flatnonzero(~linked)
    groups = []
    for i, end in enumerate(ends):
        begin = ends[i - 1] + 1 - (len(beams) if i == 0 else 0)
        run = np.arange(begin, end + 1)
        if not LEAST_BEAMS <= len(run) < len(beams):
            continue
        beside = ranges[(beams[run[0]] - 1) % len(ranges)], ranges[(beams[end] + 1) % len(ranges)]
        whole = beside[0] > ranges[beams[run[0]]] + LINK and beside[1] > ranges[beams[end]] + LINK
        if whole and float(np.linalg.norm(points[run[0]] - points[end])) <= LARGEST:
            groups.append(run)
    return groups


def _distance_to(hits: _Hits, other: _Hits) -> Array:
    """Return the distance [m] of each hit (k,) to the surface that another scan hit in its direction."""
    count = len(other.beams)
    if not count:
        return np.full(len(hits.beams), np.inf)
    away = hits.points - other.at
    turn = np.arctan2(away[:, 1], away[:, 0]) - other.heading - other.angles[0]
    first = np.searchsorted(other.angles, other.angles[0] + np.mod(turn, 2.0 * np.pi))
    begin = (first[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS)) % count
    start = other.points[begin]  # (k, 2·NEIGHBOURS, 2)
    along = np.where(other.linked[begin][..., None], other.points[(begin + 1) % count] - start, 0.0)
    square = np.maximum(np.einsum("kbd,kbd->kb", along, along), 1e-12)
    off = hits.points[:, None] - start
    share = np.clip(np.einsum("kbd,kbd->kb", off, along) / square, 0.0, 1.0)
    off -= share[..., None] * along
    return np.asarray(np.sqrt(np.einsum("kbd,kbd->kb", off, off).min(axis=1)))
