"""The rotations between the robots' frames and the world: about the vertical, by the measured headings."""

from __future__ import annotations

from typing import Any, NamedTuple

from brakeline.safety.filter.batch.obstacle_arrays import Axes

Array = Any  # of any namespace


class TurnBatch(NamedTuple):
    """The cosines and sines (B,) of the headings; None for robots without a heading, whose frame is the world's."""

    cos: Array
    sin: Array

    def to_world(self, robot: Axes) -> Axes:
        """Return vectors, per axis (..., B), in the world from vectors in the robots' frames."""
        if self.cos is None:
            return robot
        return [self.cos * robot[0] - self.sin * robot[1], self.sin * robot[0] + self.cos * robot[1], *robot[2:]]

    def to_robot(self, world: Axes) -> Axes:
        """Return vectors, per axis (..., B), in the robots' frames from vectors in the world."""
        if self.cos is None:
            return world
        return [self.cos * world[0] + self.sin * world[1], self.cos * world[1] - self.sin * world[0], *world[2:]]
