"""Add the obstacles of an arena to a MuJoCo model, to collide with."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, Obstacle
from brakeline.sim.arena import Arena
from brakeline.sim.traffic import Crowd, OtherRobots

HEIGHT = 0.4  # m, of every obstacle of an arena in the plane: taller than the robot
THICKNESS = 0.2  # m, of walls
OBSTACLE_BIT = 2  # the contact bit that the robots' geoms answer to
NO_PUSH_DEPTH = 10.0  # m; a contact pushes only deeper than this: a person who steps over the robot never does

Geom = tuple[mujoco.mjtGeom, tuple[float, float, float], tuple[float, float, float]]


def add_obstacles(spec: mujoco.MjSpec, arena: Arena) -> None:
    """Add an arena's obstacles to the world body, in their order, named `obstacle 0`, `obstacle 1`, ..., then movers.

    In the plane they stand on the floor z = 0, which this function does not add. In space they have their true heights,
    and floor and ceiling are among them. `MoverBodies` moves the movers, which nothing pushes.
    """
    for i, obstacle in enumerate(arena.obstacles):
        kind, half, position = geom_of(obstacle, arena)
        spec.worldbody.add_geom(
            name=f"obstacle {i}",
            type=kind,
            size=half,
            pos=position,
            quat=(math.cos(0.5 * obstacle.yaw), 0.0, 0.0, math.sin(0.5 * obstacle.yaw)),
            contype=OBSTACLE_BIT,
            conaffinity=0,
        )
    crowd = arena.crowd
    for i, mover in enumerate(() if crowd is None else crowd.obstacles(0.0)):
        kind, size, position = geom_of(mover, arena)
        depth = 0.0 if crowd is None or crowd.pushes else NO_PUSH_DEPTH
        body = spec.worldbody.add_body(name=f"mover {i}", mocap=True, pos=position)
        body.add_geom(
            name=f"mover {i}", type=kind, size=size, contype=OBSTACLE_BIT, conaffinity=0, margin=-depth, gap=depth
        )


class MoverBodies:
    """The moving obstacles of a compiled model, and the robot's contacts with them."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, crowd: Crowd | OtherRobots | None) -> None:
        self._data, self._crowd = data, crowd
        self._pushes = crowd is None or crowd.pushes
        self._in_contact = False
        # whether, since `begin_period`, a contact began while the robot moved, and while it stood. A robot that begins
        # to move under a person who steps over it counts as moving.
        self.contacts = [False, False]
        names = [f"mover {i}" for i in range(0 if crowd is None else len(crowd))]
        self._bodies = [int(model.body_mocapid[model.body(name).id]) for name in names]
        self._geoms = np.array([model.geom(name).id for name in names], dtype=int)

    def __bool__(self) -> bool:
        return bool(self._bodies)

    def place(self, time: float) -> None:
        """Move the obstacles to their positions at a time [s]."""
        if self._crowd is not None:
            positions, _ = self._crowd.at(max(time, 0.0))
            self._data.mocap_pos[self._bodies, : positions.shape[1]] = positions

    def begin_period(self) -> None:
        """Forget the contacts of the period before."""
        self.contacts = [False, False]

    def note_contacts(self, moving: bool) -> NDArray[np.bool_]:
        """Note the present contacts of a robot that moves or stands; return which contacts involve a mover."""
        touched = np.asarray(np.isin(self._data.contact.geom, self._geoms).any(axis=1))
        in_contact = bool(touched.any())
        if in_contact and not self._in_contact and not any(self.contacts):
            self.contacts[0 if moving else 1] = True
        elif in_contact and moving and not self._pushes:
            self.contacts[0] = True
        self._in_contact = in_contact
        return touched

    def note_no_contact(self) -> None:
        """Note that the robot touches nothing now."""
        self._in_contact = False

    @property
    def pushed(self) -> bool:
        """Whether a mover pushed the robot in this period.

        The robot is then not responsible for a contact with a static obstacle.
        """
        return self._pushes and any(self.contacts)


def geom_of(obstacle: Obstacle, arena: Arena) -> Geom:
    """Return the type, MuJoCo's half sizes and the centre of one obstacle."""
    x, y = obstacle.position[:2]
    z, height = 0.5 * HEIGHT, HEIGHT
    if arena.dim == 3:
        z, height = obstacle.position[2], obstacle.size[-1] if obstacle.size else 0.0
    if obstacle.kind == CYLINDER:
        return mujoco.mjtGeom.mjGEOM_CYLINDER, (obstacle.size[0], 0.5 * height, 0.0), (x, y, z)
    if obstacle.kind == BOX:
        return mujoco.mjtGeom.mjGEOM_BOX, (0.5 * obstacle.size[0], 0.5 * obstacle.size[1], 0.5 * height), (x, y, z)
    if obstacle.kind == SPHERE:
        if arena.dim == 2:
            raise ValueError("an arena in the plane can have no sphere; use a cylinder")
        return mujoco.mjtGeom.mjGEOM_SPHERE, (obstacle.size[0], 0.0, 0.0), (x, y, z)
    return _wall(obstacle, arena)


def _wall(wall: Obstacle, arena: Arena) -> Geom:
    """Return a wall as a box with its face in the wall's plane, as high as the room and longer than it is wide."""
    half = 0.5 * THICKNESS
    room = max(high - low for low, high in arena.bounds[:2])
    low, high = arena.bounds[2] if arena.dim == 3 else (0.0, HEIGHT)
    x, y = (wall.position[i] - half * turn(wall.yaw) for i, turn in enumerate((math.cos, math.sin)))
    return mujoco.mjtGeom.mjGEOM_BOX, (half, 1.5 * room, 0.5 * (high - low)), (x, y, 0.5 * (low + high))
