"""What the filter was told of a robot's surroundings, for whoever draws them: what a scan hit and showed to be free,
what moves and may come to where, and what robots of a fleet promise each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.robot import Robot
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import measurement_in
from brakeline.safety.perception.image_coverage import patch_free_ranges
from brakeline.safety.perception.scan_coverage import gaps

Array = NDArray[np.float64]

OUTLINE = 120  # corners of what is drawn of free space, about
SLICE = 0.5  # m above and below the sensor: what was hit within is drawn from above


@dataclass(frozen=True)
class DisplayedMap:
    """Of one question, in the world's frame, m.

    hits (k, d): where beams ended; free (c, d): the outline of what they showed to be free, as the filter takes it (in
    space: at the sensor's height); both empty without a scan. movers (n, d+1): of each that moves its place as measured
    and the radius of a disc (ball) that holds it; swept (n, N, d+1): one for the end of every period of a plan, which
    holds wherever it may be then.
    """

    hits: Array
    free: Array
    movers: Array
    swept: Array

    def flat(self, hits: int = OUTLINE) -> dict[str, list[Any]]:
        """From above, as JSON can hold it: points x, y and discs x, y, radius, in mm; so many hits at the most."""
        level = self.hits
        if level.shape[1] == 3 and len(self.free):
            level = level[np.abs(level[:, 2] - self.free[0, 2]) <= SLICE]
        some = level[:: max(1, -(-len(level) // hits)), :2]
        return {
            "hits": some.round(3).tolist(),
            "free": self.free[:, :2].round(3).tolist(),
            "movers": self.movers[..., [0, 1, -1]].round(3).tolist(),
            "swept": self.swept[..., [0, 1, -1]].round(3).tolist(),
        }


def map_for_display(robot: Robot, request: pb.Request, corners: int = OUTLINE) -> DisplayedMap:
    """What the request tells; corners: of the outline, about.

    Raises BadShape, BadScan: the request tells of none that are.
    """
    hits = free = np.zeros((0, robot.position_dim))
    sensed = measurement_in(request)
    if isinstance(sensed, Scan):
        hits, free = _hits(sensed), outline(sensed, corners)
    elif sensed is not None:
        hits, free = _image_hits(sensed), level_outline(sensed, corners)
    followed = _followed(robot, sensed) if isinstance(sensed, Scan) and sensed.tracks is not None else None
    moving = MovingObstacles.of([_obstacle(o) for o in request.obstacles if o.HasField("motion")], robot.position_dim)
    shapes, ends = moving.shapes, robot.period * np.arange(1.0, robot.horizon + 1.0)
    across: Array = shapes.rho + np.sqrt((shapes.half**2).sum(axis=1))
    swept = shapes.center[:, None] + moving.moved(ends), (across[:, None] + moving.radius(ends))[..., None]
    movers, sweeps = np.column_stack([shapes.center, across]), np.concatenate(swept, axis=2)
    if followed is not None:
        movers, sweeps = np.concatenate([movers, followed[0]]), np.concatenate([sweeps, followed[1]])
    return DisplayedMap(hits, free, movers, sweeps)


def _followed(robot: Robot, scan: Scan) -> tuple[Array, Array]:
    """Of what a scan was followed to move: the discs about what was hit of it (k, 3), and those swept (k, N, 3)."""
    assert scan.tracks is not None
    points = np.zeros((len(scan.ranges), 2))
    points[scan.known & (scan.ranges < scan.far)] = _hits(scan)
    t = scan.age + robot.period * np.arange(1.0, robot.horizon + 1.0)
    discs, swept = [np.zeros((0, 3))], [np.zeros((0, len(t), 3))]
    for row, (cx, cy, error, acceleration) in enumerate(scan.tracks.motions, start=1):
        hit = points[scan.tracks.track_index == row]
        if not len(hit) or not (cx or cy):
            continue
        middle = hit.mean(axis=0)
        about = float(np.linalg.norm(hit - middle, axis=1).max())
        discs.append(np.array([[*middle, about]]))
        grown = about + error * t + 0.5 * acceleration * t * t
        swept.append(np.column_stack([middle + t[:, None] * (cx, cy), grown])[None])
    return np.concatenate(discs), np.concatenate(swept)


def _obstacle(o: pb.Obstacle) -> Obstacle:
    return Obstacle(o.kind, tuple(o.position), tuple(o.size), o.yaw, o.margin, motion_of(o.motion))


def motion_of(m: pb.Motion) -> Motion:
    """What an obstacle's message says of how it moves."""
    before = None
    if m.before_position or m.before_velocity:
        before = Sighting(tuple(m.before_position), tuple(m.before_velocity), m.since)
    return Motion(
        tuple(m.velocity),
        m.position_error,
        m.velocity_error,
        acceleration=m.acceleration if m.HasField("acceleration") else None,
        speed=m.speed if m.HasField("speed") else None,
        age=m.age,
        before=before,
    )


def _hits(scan: Scan) -> Array:
    """(k, 2)"""
    at, heading = scan.sensor()
    hit = scan.known & (scan.ranges < scan.far)
    angles = heading + scan.angles[hit]
    return np.asarray(at + scan.ranges[hit, None] * np.column_stack([np.cos(angles), np.sin(angles)]))


def outline(scan: Scan, most: int = OUTLINE) -> Array:
    """Corners (c, 2) of a part of what the scan shows to be free, all round the sensor: neighbouring gaps in groups,
    each up to the least F of its group."""
    at, heading = scan.sensor()
    angles, width, free = gaps(scan)
    first = np.arange(0, len(free), max(1, 2 * len(free) // most))
    reach = np.minimum.reduceat(free, first)
    ends = np.append(angles[first[1:]], angles[-1] + width[-1])
    sides = heading + np.column_stack([angles[first], ends]).ravel()
    return np.asarray(at + np.repeat(reach, 2)[:, None] * np.column_stack([np.cos(sides), np.sin(sides)]))


def _image_hits(image: RangeImage) -> Array:
    """(k, 3)"""
    elevations = image.low + image.step[0] * np.arange(len(image.ranges))
    hit = image.known & (image.ranges < image.far)
    ways = directions(elevations, image.ranges.shape[1])[hit]
    return np.asarray(image.sensor() + image.ranges[hit, None] * ways @ image.turn.T)


def level_outline(image: RangeImage, most: int = OUTLINE) -> Array:
    """Corners (c, 3) of a part of what the image shows to be free at the sensor's height: the least F of each group of
    columns, in the ring nearest to level."""
    grid, free = patch_free_ranges(image)
    elevations = grid.elevations
    ring = int(np.abs(elevations).argmin())
    columns = free.shape[1]
    first = np.arange(0, columns, max(1, 2 * columns // most))
    reach = np.repeat(np.minimum.reduceat(free[ring], first), 2)
    sides = np.column_stack([first, np.append(first[1:], columns)]).ravel() - 0.5
    ways = directions(np.zeros(1), columns, sides)[0]
    return np.asarray(image.sensor() + reach[:, None] * ways @ image.turn.T)


def reserved_boxes(robot: Robot, exchange: pb.Exchange) -> Array:
    """What a robot of a fleet promises the others from this question on, boxes (N, 2d+1): center, half-widths, and the
    radius about them; (0, 2d+1): nothing."""
    decision = exchange.reply.decision
    reservation = decision.reservation if decision.HasField("reservation") else exchange.request.reservation
    d = robot.position_dim
    sizes = len(reservation.center), len(reservation.half_width), d * len(reservation.radius)
    if len(set(sizes)) != 1:
        return np.zeros((0, 2 * d + 1))
    boxes = np.reshape(reservation.center, (-1, d)), np.reshape(reservation.half_width, (-1, d))
    return np.column_stack([*boxes, np.asarray(reservation.radius, float)])
