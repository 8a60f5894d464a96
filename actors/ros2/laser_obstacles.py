"""Convert a laser scan to obstacles that contain everything the scan may have hit (docs/method.md §10).

A beam that hits at range r becomes a disc of radius

    increment r + way + range error + heading error (r + m) + position error

with m the sensor's distance from the robot's position. The increment and the way of the sensor from beam to beam cover
the gap to the next beam, since an edge may be anywhere in it; a turn of the robot adds to the increment. The others
cover the error of the hit's position. Between the last beam and the first, the gap is wider by the sensor's way during
the turn. Neighbouring hits that the body cannot pass between are joined to boxes, so that a wall is one obstacle and
not a hundred. A beam without a hit is free up to the sensor's range. Something too near to be measured touches the body
where the beam leaves it. Beams without information are left out here: `unknown_space.py` says what may be there.

Assumptions: nothing moves, and no obstacle is narrower than the gap between two beams at the distance where it matters
(7 mm at 0.4 m with 360 beams). The scan shows an obstacle in the one gap behind an edge only after the robot has come
around that edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.ros2.laser_beams import LaserBeams
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.messaging.obstacle import BOX, CYLINDER, Obstacle
from brakeline.messaging.robot import Array, Robot

EXTRA_SIGHT = 0.2  # m: hits count up to the robot's sight plus this, since it drives on until the next scan
STRAIGHT = 0.02  # m: hits that are nearer to a line belong to one wall


@dataclass(frozen=True)
class HitErrors:
    """The largest errors of a hit: its range [m], and heading [rad] and position [m] of the robot."""

    range: float
    heading: float
    position: float

    @staticmethod
    def of(robot: Robot, range_error: float) -> HitErrors:
        """Take the errors of the pose from the robot's measurement bound."""
        assert robot.heading is not None
        bound = robot.measurement_bound
        return HitErrors(range_error, bound[robot.heading], math.hypot(*bound[: robot.position_dim]))


def obstacles(
    beams: LaserBeams, poses: Array, mount: PlanarPose, robot: Robot, errors: HitErrors, around: Array
) -> tuple[Obstacle, ...]:
    """Return all obstacles that may be near a position.

    Args:
        beams: the n beams of a scan.
        poses: (n, ≥ 3) x, y [m], heading [rad] of the robot at the beams' times.
        mount: the sensor's pose on the robot.
        around: (2,) m, the position, in the frame of the poses. What is too near to be measured touches the body there.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    sensor = poses[:, :2] + np.stack([cos * mount.x - sin * mount.y, sin * mount.x + cos * mount.y], axis=1)
    angles = poses[:, 2] + mount.yaw + beams.angles
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    swing = errors.heading * math.hypot(mount.x, mount.y)  # a wrong heading also moves the sensor about the robot
    with np.errstate(invalid="ignore"):
        points = sensor + beams.ranges[:, None] * directions
        turn, way = _between_beams(beams, poses, sensor)
        radii = (beams.gap + turn + errors.heading) * beams.ranges + way + swing + errors.range + errors.position
        far = np.linalg.norm(points - around, axis=1) > robot.sight + EXTRA_SIGHT + radii
    # A hit whose place is NaN counts as near: it makes no obstacle, and without one nothing is decided.
    near = ~(far | beams.too_near)
    chosen = np.flatnonzero(near)
    order = chosen[np.argsort(beams.angles[chosen], kind="stable")]
    hits = _joined(*_with_seam(points, radii, directions, sensor, order), 2.0 * robot.footprint)
    size = max(0.5 * beams.gap, 1e-3) * robot.footprint + errors.position
    leaves = _leaving(sensor[beams.too_near] - around, directions[beams.too_near], robot.footprint)
    touching = around + (robot.footprint + size) * leaves
    return (*hits, *_joined(touching, np.full(len(touching), size), 2.0 * robot.footprint))


def _between_beams(beams: LaserBeams, poses: Array, sensor: Array) -> tuple[float, float]:
    """Return by how much the robot turns [rad], and how far the sensor moves [m], from one beam to the next."""
    if len(poses) < 2:
        return 0.0, 0.0
    steps = max(abs(float(beams.angles[-1] - beams.angles[0])) / beams.gap, 1.0)
    return abs(float(poses[-1, 2] - poses[0, 2])) / steps, float(np.linalg.norm(sensor[-1] - sensor[0])) / steps


def _with_seam(
    points: Array, radii: Array, directions: Array, sensor: Array, order: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Return the hits in an order by angle, with one more beside the first beam and one beside the last.

    The sensor moves during a turn, so the last beam does not begin where the first one does. An obstacle that one of
    them hits may end anywhere in the strip between them, which is as wide as the sensor's way across them.
    """
    if not len(order):
        return points[order], radii[order]
    across = np.stack([-directions[:, 1], directions[:, 0]], axis=1)  # counterclockwise
    outer = order[[0, -1]]
    moved = np.abs(across[outer] @ (sensor[-1] - sensor[0]))
    moved[~np.isin(outer, (0, len(points) - 1))] = 0.0  # the beam beside the seam hit nothing
    beside = points[outer] + np.array([[-1.0], [1.0]]) * moved[:, None] * across[outer]
    order = np.concatenate([outer[:1], order, outer[1:]])
    shown = points[order]
    shown[0], shown[-1] = beside
    return shown, radii[order]


def _leaving(sensor: Array, directions: Array, body: float) -> Array:
    """Return the directions (n, 2), from the middle of a body of a radius [m], to where beams leave it.

    sensor: (n, 2) m from the middle, where each beam begins; one outside the body leaves it there.
    """
    along = np.einsum("nd,nd->n", sensor, directions)
    inside = np.maximum(body * body - np.einsum("nd,nd->n", sensor, sensor), 0.0)
    length = np.where(inside > 0.0, np.sqrt(along * along + inside) - along, 0.0)
    points = sensor + length[:, None] * directions
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def _joined(points: Array, radii: Array, body: float) -> list[Obstacle]:
    """Return few obstacles that contain all discs (n,), which are in their order around the sensor.

    points: (n, 2) m, their centers; radii: (n,) m; body: m, the width of the narrowest gap that the body may pass.
    """
    n = len(points)
    if n == 0:
        return []
    gaps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1) - radii - np.roll(radii, -1)
    open_after = np.flatnonzero(gaps > body)  # the body may pass between these discs and the next ones
    if not len(open_after):
        closed = np.concatenate([np.arange(n), [0]]) if n > 2 else np.arange(n)
        return _along(points[closed], radii[closed])
    starts = (open_after + 1) % n
    obstacles = []
    for i, start in enumerate(starts):
        end = open_after[(i + 1) % len(open_after)]
        count = (end - start) % n + 1
        run = (start + np.arange(count)) % n
        obstacles += _along(points[run], radii[run])
    return obstacles


def _along(points: Array, radii: Array) -> list[Obstacle]:
    """Return boxes along the straight parts of a chain of discs; two parts share the disc where they meet."""
    if len(points) == 1:
        return [Obstacle(CYLINDER, (float(points[0, 0]), float(points[0, 1])), (float(radii[0]),))]
    chord = points[-1] - points[0]
    length = float(np.linalg.norm(chord))
    along = chord / length if length > 1e-9 else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    offsets = (points - points[0]) @ across
    worst = int(np.argmax(np.abs(offsets))) if length > 1e-9 else len(points) // 2
    bent = abs(offsets[worst]) > STRAIGHT or length <= 1e-9
    if bent and 0 < worst < len(points) - 1:
        return _along(points[: worst + 1], radii[: worst + 1]) + _along(points[worst:], radii[worst:])
    local = np.stack([(points - points[0]) @ along, offsets], axis=1)
    low, high = (local - radii[:, None]).min(axis=0), (local + radii[:, None]).max(axis=0)
    middle, edges = 0.5 * (low + high), high - low
    center = points[0] + middle[0] * along + middle[1] * across
    yaw = math.atan2(along[1], along[0])
    return [Obstacle(BOX, (float(center[0]), float(center[1])), (float(edges[0]), float(edges[1])), yaw)]
