"""Obstacles of an arena as MuJoCo geoms: to collide with, and to cast rays at."""

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
DEEP = 10.0  # m: so far in would a mover have to be that steps over whoever stands, to push him

Geom = tuple[mujoco.mjtGeom, tuple[float, float, float], tuple[float, float, float]]


def compile_ground_model(model: str, arena: Arena, height: float) -> mujoco.MjModel:
    """Compile a robot in the plane (MJCF with a body `base`) and an arena, the robot standing at the start, its base at
    that height [m]."""
    spec = mujoco.MjSpec.from_string(model)
    add_obstacles(spec, arena)
    add_movers(spec, arena.crowd)
    base = spec.body("base")
    x, y, heading = arena.start
    base.pos = (x, y, height)
    base.quat = (math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading))
    return spec.compile()


def add_obstacles(spec: mujoco.MjSpec, arena: Arena) -> None:
    """Add an arena's obstacles to the world body, in their order, named `obstacle 0`, `obstacle 1`, …

    Those of an arena in the plane stand on the floor z = 0 (which is not theirs to add); in space all have their true
    heights, and floor and ceiling are among them.
    """
    for i, obstacle in enumerate(arena.obstacles):
        kind, half, position = _geom(obstacle, arena)
        spec.worldbody.add_geom(
            name=f"obstacle {i}",
            type=kind,
            size=half,
            pos=position,
            quat=(math.cos(0.5 * obstacle.yaw), 0.0, 0.0, math.sin(0.5 * obstacle.yaw)),
            contype=OBSTACLE_BIT,
            conaffinity=0,
        )


def add_movers(spec: mujoco.MjSpec, crowd: Crowd | OtherRobots | None) -> None:
    """Add each moving obstacle as a body without contact forces, named `mover 0`, `mover 1`, …"""
    for i, mover in enumerate(() if crowd is None else crowd.obstacles(0.0)):
        flat = len(mover.position) == 2
        z = 0.5 * HEIGHT if flat else mover.position[2]
        body = spec.worldbody.add_body(name=f"mover {i}", mocap=True, pos=(*mover.position[:2], z))
        radius = mover.size[0]
        body.add_geom(
            name=f"mover {i}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER if flat else mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(radius, 0.5 * HEIGHT, 0.0) if flat else (radius, 0.0, 0.0),
            contype=OBSTACLE_BIT,
            conaffinity=0,
            margin=0.0 if crowd is None or crowd.pushes else -DEEP,
            gap=0.0 if crowd is None or crowd.pushes else DEEP,
        )


class MoverBodies:
    """The movers of a compiled model, and how a robot met them.

    contacts: since `begin` one began while the robot moved, while it stood. Under somebody who steps over it, it must
    not begin to move either.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, crowd: Crowd | OtherRobots | None) -> None:
        self._data, self._crowd = data, crowd
        self._pushes = crowd is None or crowd.pushes
        self._meeting = False  # one is touched now
        self.contacts = [False, False]
        names = [f"mover {i}" for i in range(0 if crowd is None else len(crowd))]
        self._bodies = [int(model.body_mocapid[model.body(name).id]) for name in names]
        self._geoms = np.array([model.geom(name).id for name in names], dtype=int)

    def __bool__(self) -> bool:
        return bool(self._bodies)

    def place(self, time: float) -> None:
        """Put them where they are at that time, s."""
        if self._crowd is not None:
            positions, _ = self._crowd.at(max(time, 0.0))
            self._data.mocap_pos[self._bodies, : positions.shape[1]] = positions

    def begin(self) -> None:
        """A period begins."""
        self.contacts = [False, False]

    def meet(self, moving: bool) -> NDArray[np.bool_]:
        """Note what is touched now by a robot that moves or stands. Of each contact: is one of them in it?"""
        touched = np.asarray(np.isin(self._data.contact.geom, self._geoms).any(axis=1))
        now = bool(touched.any())
        if now and not self._meeting and not any(self.contacts):
            self.contacts[0 if moving else 1] = True
        elif now and moving and not self._pushes:
            self.contacts[0] = True
        self._meeting = now
        return touched

    def part(self) -> None:
        """Nothing is touched now."""
        self._meeting = False

    @property
    def pushed(self) -> bool:
        """Was the robot, in this period? What it then touches is of that contact."""
        return self._pushes and any(self.contacts)


def _geom(obstacle: Obstacle, arena: Arena) -> Geom:
    """Type, MuJoCo's half sizes and centre of one obstacle."""
    x, y = obstacle.position[:2]
    z, tall = 0.5 * HEIGHT, HEIGHT
    if arena.dim == 3:
        z, tall = obstacle.position[2], obstacle.size[-1] if obstacle.size else 0.0
    if obstacle.kind == CYLINDER:
        return mujoco.mjtGeom.mjGEOM_CYLINDER, (obstacle.size[0], 0.5 * tall, 0.0), (x, y, z)
    if obstacle.kind == BOX:
        return mujoco.mjtGeom.mjGEOM_BOX, (0.5 * obstacle.size[0], 0.5 * obstacle.size[1], 0.5 * tall), (x, y, z)
    if obstacle.kind == SPHERE:
        if arena.dim == 2:
            raise ValueError("an arena on the ground has no sphere")
        return mujoco.mjtGeom.mjGEOM_SPHERE, (obstacle.size[0], 0.0, 0.0), (x, y, z)
    return _wall(obstacle, arena)


def _wall(wall: Obstacle, arena: Arena) -> Geom:
    """A wall as a box with its face in the plane, as tall as the room; however it is turned, it ends outside."""
    half = 0.5 * THICKNESS
    room = max(high - low for low, high in arena.bounds[:2])
    low, high = arena.bounds[2] if arena.dim == 3 else (0.0, HEIGHT)
    x, y = (wall.position[i] - half * turn(wall.yaw) for i, turn in enumerate((math.cos, math.sin)))
    return mujoco.mjtGeom.mjGEOM_BOX, (half, 1.5 * room, 0.5 * (high - low)), (x, y, 0.5 * (low + high))


def map_model(arena: Arena) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The obstacles alone, compiled, with their places computed: what a sensor can be simulated on without a robot."""
    spec = mujoco.MjSpec()
    add_obstacles(spec, arena)
    add_movers(spec, arena.crowd)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data
