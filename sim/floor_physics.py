"""Physics of one robot on a floor among the obstacles of an arena, in MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from brakeline.sim.arena import Arena
from brakeline.sim.mujoco_obstacles import MoverBodies, add_obstacles

STANDING = 0.02  # m/s; a robot at rest by its input stands below this speed


class FloorPhysics:
    """One robot and one arena, compiled.

    A collision is any contact, at any physics step, with a static obstacle. The robot's geoms answer to the contact
    bits 1 (floor) and 2 (obstacles) and offer none, so they never touch each other.
    """

    def __init__(self, mjcf: str, height: float, arena: Arena, sample_time: float, period: float) -> None:
        """Compile the model with the robot at the start of the arena.

        Args:
            mjcf: the robot, with a body `base` that has a free joint, and the floor as its first geom.
            height: height of the origin of the base above the floor [m].
            sample_time: time that each call of `advance` simulates [s].
            period: time for the robot to settle on its wheels before the episode starts at time 0 [s].
        """
        spec = mujoco.MjSpec.from_string(mjcf)
        add_obstacles(spec, arena)
        place_base(spec.body("base"), arena, height)
        # model, data: MuJoCo's; the robot's coordinates come first
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        # the moving obstacles, and whether the robot touched one
        self.movers = MoverBodies(self.model, self.data, arena.crowd)
        self._time = -period
        self._steps = round(sample_time / self.model.opt.timestep)

    def advance(self, at_rest: bool, control: Callable[[], None] | None = None, apart: bool = False) -> bool:
        """Advance by one sample and return whether the robot collided.

        Args:
            at_rest: whether the robot's input is that of standing still.
            control: called before each physics step to set the actuators.
            apart: whether every obstacle stands still, and too far away to be touched in this sample. The motion is
                the same, to the bit, and takes less time.
        """
        model, data, collision = self.model, self.data, False
        if apart and control is None:
            mujoco.mj_step2(model, data)
            if self._steps > 1:
                mujoco.mj_step(model, data, self._steps - 1)
            mujoco.mj_step1(model, data)
            return False
        for _ in range(self._steps):
            moving = not at_rest or math.hypot(*data.qvel[:2].tolist()) > STANDING
            if self.movers:
                self._time += model.opt.timestep
                self.movers.place(self._time)
            if control is not None:
                control()
            # step2 before step1, so that the contacts belong to the new position
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            collision = self._touches(moving) or collision
        return collision

    def _touches(self, moving: bool) -> bool:
        """Return whether the robot touches a static obstacle now; note contacts with moving obstacles.

        The floor is geom 0: a plane is the lowest type of geom, and a contact names the geom of lower type first.
        """
        first = self.data.contact.geom[:, 0]
        if self.movers:
            first = first * ~self.movers.note_contacts(moving)
        return bool(np.count_nonzero(first)) and not self.movers.pushed


def place_base(base: mujoco.MjsBody, arena: Arena, height: float) -> None:
    """Place a robot's base at the start of an arena in the plane, at a height [m]."""
    x, y, heading = arena.start
    base.pos = (x, y, height)
    base.quat = (math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading))
