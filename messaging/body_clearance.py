"""The distance from a robot's body to the nearest obstacle."""

from __future__ import annotations

import numpy as np

from brakeline.messaging.obstacle import Array, Shapes, rotate
from brakeline.messaging.robot import Robot


def body_clearance(robot: Robot, shapes: Shapes, states: Array) -> Array:
    """Return the distance (...) [m] from the nearest disc (sphere) of the body to the nearest obstacle, or inf.

    A disc whose center is in an obstacle counts as minus its radius.

    Args:
        robot: has the body. Without a heading, its discs are about the position.
        shapes: the obstacles.
        states: (..., n), or positions (..., d) of a robot whose discs are all about the position.
    """
    if not (len(shapes) and robot.body):
        return np.full(states.shape[:-1], np.inf)
    centers = np.array([disc.at for disc in robot.body])
    positions = states[..., None, : robot.position_dim] + np.zeros_like(centers)
    if robot.heading is not None and centers.any():
        turned = np.broadcast_to(centers, positions.shape)
        positions = positions + rotate(turned, states[..., robot.heading, None])
    apart = shapes.distance(positions).min(axis=0) - [disc.radius for disc in robot.body]
    return np.asarray(apart.min(axis=-1))
