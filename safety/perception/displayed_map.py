"""A robot's local map as its request describes it, for programs that draw it.

It holds what a scan hit and showed to be free, where moving obstacles may come, and the space that robots of a fleet
reserve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle_messages import obstacle_of
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import measurement_in
from brakeline.safety.perception.image_coverage import patch_free_ranges
from brakeline.safety.perception.scan_coverage import gaps, hits_of

OUTLINE = 120  # corners of a drawn outline, about
SWEPT = 4  # periods at whose end the reach of a moving obstacle is drawn on pages
SLICE = 0.5  # m: hits this far above or below the sensor are drawn from above


@dataclass(frozen=True)
class DisplayedMap:
    """The local map of one request, in the world's frame."""

    hits: Array  # (k, d) ends of the beams that hit something [m]; empty without a scan
    # (c, d) outline of the space that the scan showed to be free [m], as the filter takes it. In space, it is the
    # outline at the sensor's height. Empty without a scan.
    free: Array
    movers: Array  # (n, d+1) measured center, and radius of a disc or ball around each moving obstacle [m]
    swept: Array  # (n, N, d+1) the same at the end of each period of a plan, with room for wherever the obstacle may be

    def flat(self, hits: int = OUTLINE) -> dict[str, list[Any]]:
        """Return the map as values for JSON, rounded to 1 mm: points (d numbers), and discs or balls (d + 1 numbers).

        Args:
            hits: largest number of hits. In space, they are those near the sensor's height.

        Of the periods of `swept`, it has the last one and at most `SWEPT` - 1 before it, evenly spread.
        """
        level = self.hits
        if level.shape[1] == 3 and len(self.free):
            level = level[np.abs(level[:, 2] - self.free[0, 2]) <= SLICE]
        every = max(1, -(-self.swept.shape[1] // SWEPT))
        some = level[:: max(1, -(-len(level) // hits))]
        return {
            "hits": some.round(3).tolist(),
            "free": self.free.round(3).tolist(),
            "movers": self.movers.round(3).tolist(),
            "swept": self.swept[:, ::-1][:, ::every][:, ::-1].round(3).tolist(),
        }


def map_for_display(robot: Robot, request: pb.Request, corners: int = OUTLINE) -> DisplayedMap:
    """Return the map that a request describes; corners: of the outline, about.

    Raises:
        BadShape, BadScan: the request holds an obstacle or a scan that is not valid.
    """
    hits = free = np.zeros((0, robot.position_dim))
    sensed = measurement_in(request)
    if isinstance(sensed, Scan):
        (_, hits), free = hits_of(sensed), _scan_outline(sensed, corners)
    elif sensed is not None:
        hits, free = _image_hits(sensed), _image_outline(sensed, corners)
    moving = [obstacle_of(o, robot.position_dim) for o in request.obstacles if o.HasField("motion")]
    obstacles = MovingObstacles.of(moving, robot.position_dim)
    shapes, ends = obstacles.shapes, robot.period * np.arange(1.0, robot.horizon + 1.0)
    radius: Array = shapes.rho + np.sqrt((shapes.half**2).sum(axis=1))
    centers, radii = shapes.center[:, None] + obstacles.moved(ends), radius[:, None] + obstacles.radius(ends)
    movers, swept = np.column_stack([shapes.center, radius]), np.concatenate([centers, radii[..., None]], axis=2)
    if isinstance(sensed, Scan) and sensed.tracks is not None:
        tracked = _tracked(sensed, sensed.age + ends)
        movers, swept = np.concatenate([movers, tracked[0]]), np.concatenate([swept, tracked[1]])
    return DisplayedMap(hits, free, movers, swept)


def _tracked(scan: Scan, times: Array) -> tuple[Array, Array]:
    """Return a disc around the hits of each tracked surface (k, 3), and that disc at times (N,) [s] after the scan."""
    assert scan.tracks is not None
    beams, ends = hits_of(scan)
    which = scan.tracks.track_index[beams]
    discs, swept = [np.zeros((0, 3))], [np.zeros((0, len(times), 3))]
    for number, (vx, vy, error, acceleration) in enumerate(scan.tracks.motions, start=1):
        hits = ends[which == number]
        if not len(hits) or not (vx or vy):
            continue
        center = hits.mean(axis=0)
        radius = float(np.linalg.norm(hits - center, axis=1).max())
        discs.append(np.array([[*center, radius]]))
        radii = radius + error * times + 0.5 * acceleration * times * times
        swept.append(np.column_stack([center + times[:, None] * (vx, vy), radii])[None])
    return np.concatenate(discs), np.concatenate(swept)


def _scan_outline(scan: Scan, most: int) -> Array:
    """Return corners (c, 2) of free space: neighbouring gaps in groups, each up to the least F of its group."""
    at, heading = scan.sensor()
    angles, width, free = gaps(scan)
    first = np.arange(0, len(free), max(1, 2 * len(free) // most))
    reach = np.minimum.reduceat(free, first)
    ends = np.append(angles[first[1:]], angles[-1] + width[-1])
    sides = heading + np.column_stack([angles[first], ends]).ravel()
    return np.asarray(at + np.repeat(reach, 2)[:, None] * np.column_stack([np.cos(sides), np.sin(sides)]))


def _image_hits(image: RangeImage) -> Array:
    """Return the ends (k, 3) of the beams that hit something."""
    elevations = image.low + image.step[0] * np.arange(len(image.ranges))
    hit = image.valid_beams & (image.ranges < image.far)
    ways = directions(elevations, image.ranges.shape[1])[hit]
    return np.asarray(image.sensor() + image.ranges[hit, None] * ways @ image.rotation.T)


def _image_outline(image: RangeImage, most: int) -> Array:
    """Return corners (c, 3) of free space at the sensor's height: least F by groups of columns in the level ring."""
    grid, free = patch_free_ranges(image)
    ring = int(np.abs(grid.elevations).argmin())
    columns = free.shape[1]
    first = np.arange(0, columns, max(1, 2 * columns // most))
    reach = np.repeat(np.minimum.reduceat(free[ring], first), 2)
    sides = np.column_stack([first, np.append(first[1:], columns)]).ravel() - 0.5
    ways = directions(np.zeros(1), columns, sides)[0]
    return np.asarray(image.sensor() + reach[:, None] * ways @ image.rotation.T)


def reserved_boxes(robot: Robot, exchange: pb.Exchange) -> Array:
    """Return the boxes (N, 2d+1) that a robot of a fleet reserves after an exchange with the service.

    A row holds the center (d,), the half-widths (d,) and the radius around the box [m]. Without a reservation there are
    no rows.
    """
    decision = exchange.reply.decision
    reservation = decision.reservation if decision.HasField("reservation") else exchange.request.reservation
    d = robot.position_dim
    sizes = len(reservation.center), len(reservation.half_width), d * len(reservation.radius)
    if len(set(sizes)) != 1:
        return np.zeros((0, 2 * d + 1))
    boxes = np.reshape(reservation.center, (-1, d)), np.reshape(reservation.half_width, (-1, d))
    return np.column_stack([*boxes, np.asarray(reservation.radius, float)])
