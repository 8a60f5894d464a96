"""From a laser scan to obstacles that hold all it may have seen (docs/method.md §10).

A beam that hits at range r becomes a disc of radius `increment r + range error + heading error r + position error`:
the gap to the next beam, before which an edge may lie anywhere, and how wrong the hit's place may be. Neighbouring hits
that the body can't pass between are joined to boxes along them, so that a wall is one obstacle and not a hundred. A
beam without a hit is free up to the sensor's range. One that tells nothing (too near, NaN), and directions that no beam
looks in, may have something standing right at the body: they count as occupied there, and there is no memory of what
was seen free before.

What it assumes: nothing moves, and nothing is narrower than the gap between two beams where it matters (at 360 beams
7 mm in 0.4 m). What stands behind an edge, within the one gap between the beams on both sides of it, is seen when the
robot has come round.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.robot import Robot
from brakeline.messaging.ros2.cdr_messages import LaserScan, seconds

Array = NDArray[np.float64]

SLACK = 0.2  # m beyond a robot's sight up to which hits are kept: it drives on until the next scan
STRAIGHT = 0.02  # m: hits that lie so near to a line are on one wall
MOST = 10_000  # beams


class BadScan(ValueError):
    """Not a scan that anything can be seen from."""


@dataclass(frozen=True)
class HitErrors:
    """Of a hit's place: range [m]; heading [rad] and position [m] of the pose that it was seen from."""

    range: float
    heading: float
    position: float

    @staticmethod
    def of(robot: Robot, range_error: float) -> HitErrors:
        """With the pose as wrong as the robot's measurements may be."""
        assert robot.heading is not None
        bound = robot.measurement_bound
        return HitErrors(range_error, bound[robot.heading], math.hypot(*bound[: robot.position_dim]))


@dataclass(frozen=True)
class LaserBeams:
    """What a scan says, beam by beam: time [s], angle [rad] in the sensor's frame, range [m] up to which it is free: to
    a hit, or to where the sensor sees no farther. blind: which say nothing; they have no range."""

    times: Array
    angles: Array
    ranges: Array
    blind: NDArray[np.bool_]
    gap: float  # rad between neighbours


def read(scan: LaserScan, zero_is_free: bool = False) -> LaserBeams:
    """zero_is_free: the driver reports 0 where nothing is within range, as some do (by REP 117 it should be inf).

    Raises:
        BadScan: angles or ranges make no sense.
    """
    ranges = np.asarray(scan.ranges, dtype=float)
    n, gap = len(ranges), float(scan.angle_increment)
    limits = (scan.range_min, scan.range_max, scan.angle_min, gap, scan.time_increment)
    if not (2 <= n <= MOST and all(map(math.isfinite, limits)) and abs(gap) > 1.0 / MOST):
        raise BadScan(f"{n} beams, {gap:g} rad apart")
    if not 0.0 <= scan.range_min < scan.range_max:
        raise BadScan(f"ranges from {scan.range_min:g} m to {scan.range_max:g} m")
    times = seconds(scan.header.stamp) + float(scan.time_increment) * np.arange(n)
    angles = scan.angle_min + gap * np.arange(n)
    hit = (ranges >= scan.range_min) & (ranges <= scan.range_max)  # NaN is neither
    free = ranges > scan.range_max
    if zero_is_free:
        free |= ranges == 0.0
    known = np.where(free, scan.range_max, np.where(hit, ranges, np.nan))
    unseen = _unseen(float(scan.angle_min), gap, n)
    known = np.concatenate([known, np.full(len(unseen), np.nan)])
    times = np.concatenate([times, np.full(len(unseen), times[-1])])
    ways = np.asarray(known, dtype=float)
    return LaserBeams(np.asarray(times, float), np.concatenate([angles, unseen]), ways, np.isnan(ways), abs(gap))


def _unseen(first: float, gap: float, count: int) -> Array:
    """Angles, as close as the beams, of the directions that a fan leaves out."""
    left = 2.0 * math.pi - abs(gap) * count
    more = math.ceil(left / abs(gap) - 0.5)  # a beam's rounding is no sector
    return np.asarray(first + gap * (count + np.arange(max(more, 0))))


def obstacles(
    beams: LaserBeams, poses: Array, mount: PlanarPose, robot: Robot, errors: HitErrors, around: Array
) -> tuple[Obstacle, ...]:
    """What may stand near `around` (2,) [m], in the frame of the poses (n, 3) that the robot had at the beams' times.

    Where a beam is blind, an obstacle touches the body as it stands at `around`.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    sensor = poses[:, :2] + np.stack([cos * mount.x - sin * mount.y, sin * mount.x + cos * mount.y], axis=1)
    angles = poses[:, 2] + mount.yaw + beams.angles
    beside = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    with np.errstate(invalid="ignore"):
        points = sensor + beams.ranges[:, None] * beside
        radii = (beams.gap + errors.heading) * beams.ranges + errors.range + errors.position
        near = np.linalg.norm(points - around, axis=1) <= robot.sight + SLACK + radii
    chosen = np.flatnonzero(near)
    order = chosen[np.argsort(beams.angles[chosen], kind="stable")]
    found = _joined(points[order], radii[order], 2.0 * robot.footprint)
    blind = beside[beams.blind]
    size = max(0.5 * beams.gap, 1e-3) * robot.footprint + errors.position
    touching = around + (robot.footprint + size) * blind
    return (*found, *_joined(touching, np.full(len(touching), size), 2.0 * robot.footprint))


def _joined(points: Array, radii: Array, body: float) -> list[Obstacle]:
    """Discs (n,) in the order in which they are met around the sensor, as few obstacles that hold them all."""
    n = len(points)
    if n == 0:
        return []
    apart = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1) - radii - np.roll(radii, -1)
    open_after = np.flatnonzero(apart > body)  # the body may fit between these and the next
    if not len(open_after):
        closed = np.concatenate([np.arange(n), [0]]) if n > 2 else np.arange(n)
        return _along(points[closed], radii[closed])
    starts = (open_after + 1) % n
    found = []
    for i, start in enumerate(starts):
        end = open_after[(i + 1) % len(open_after)]
        count = (end - start) % n + 1
        run = (start + np.arange(count)) % n
        found += _along(points[run], radii[run])
    return found


def _along(points: Array, radii: Array) -> list[Obstacle]:
    """A chain of discs as boxes along its straight parts; two parts share the disc where they meet."""
    if len(points) == 1:
        return [Obstacle(CYLINDER, (float(points[0, 0]), float(points[0, 1])), (float(radii[0]),))]
    chord = points[-1] - points[0]
    length = float(np.linalg.norm(chord))
    along = chord / length if length > 1e-9 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    off = (points - points[0]) @ across
    worst = int(np.argmax(np.abs(off))) if length > 1e-9 else len(points) // 2
    bent = abs(off[worst]) > STRAIGHT or length <= 1e-9
    if bent and 0 < worst < len(points) - 1:
        return _along(points[: worst + 1], radii[: worst + 1]) + _along(points[worst:], radii[worst:])
    on = (points - points[0]) @ along
    low, high = np.array([(on - radii).min(), (off - radii).min()]), np.array([(on + radii).max(), (off + radii).max()])
    middle, edges = 0.5 * (low + high), high - low
    center = points[0] + middle[0] * along + middle[1] * across
    yaw = math.atan2(along[1], along[0])
    return [Obstacle(BOX, (float(center[0]), float(center[1])), (float(edges[0]), float(edges[1])), yaw)]
