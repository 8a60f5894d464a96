"""Notice obstacles that a program gives in the robot's frame. They belong into the frame of the state's position.

The filter cannot know: near the origin, both frames give nearly the same positions. As the robot drives, obstacles in
its own frame seem to come towards it, at exactly its own speed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from brakeline.messaging.obstacle import Obstacle, rotate
from brakeline.messaging.robot import Array, Robot

log = logging.getLogger("brakeline.safety")

PERIODS = 100  # of an episode that are compared
MOVED = 0.1  # m, and ten times the error of a position: least motion of each obstacle that is compared
SAME = 0.2  # of this motion: obstacles that move less in the robot's frame stand still there


class ObstacleFrame:
    """Compares standing obstacles of an episode's first periods, and warns once if they are in the robot's frame."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._moved = max([MOVED, *(10.0 * error for error in robot.measurement_bound[: robot.position_dim])])
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._left = PERIODS if self._robot.position_dim else 0
        self._first: tuple[Array, Array] | None = None  # positions (k, d): as given, and if they are the robot's

    def see(self, state: Array, obstacles: Sequence[Obstacle] | None) -> None:
        """Compare the obstacles of a request, for a robot with this measured state (n,), with those of the first."""
        if not self._left or not obstacles:
            return
        self._left -= 1
        d = self._robot.position_dim
        given = np.array([one.position for one in obstacles if one.motion is None and len(one.position) == d])
        if not len(given) or len(state) != self._robot.state_dim:
            return
        turn = 0.0 if self._robot.heading is None else float(state[self._robot.heading])
        if_own = state[:d] + rotate(given, turn)
        if self._first is None or len(self._first[0]) != len(given):
            self._first = given, if_own
            return
        pairs = zip((given, if_own), self._first, strict=True)
        moved, still = (np.linalg.norm(now - then, axis=1) for now, then in pairs)
        if moved.min() > self._moved and still.max() < SAME * moved.min():
            self._left = 0
            log.warning(
                "%s: the obstacles come towards the robot at its own speed. Are they in the robot's frame? Give them "
                "in the frame of the state's position (map or odometry), or as a Scan; moving ones with `motion`",
                self._robot.name,
            )
