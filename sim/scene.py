"""Obstacles of an arena as MuJoCo geoms."""

from __future__ import annotations

import math

import mujoco

from messaging.shapes import BOX, CYLINDER, WALL, Obstacle
from sim.world import Arena

HEIGHT = 0.4  # m, of every obstacle: taller than the robot
THICKNESS = 0.2  # m, of walls
OBSTACLE_BIT = 2  # the contact bit that the robots' geoms answer to


def add_obstacles(spec: mujoco.MjSpec, arena: Arena) -> None:
    """Add an arena's obstacles to the world body, in their order, named `obstacle 0`, `obstacle 1`, …"""
    for i, obstacle in enumerate(arena.obstacles):
        kind, size, position = _geom(obstacle, arena.bounds[1] - arena.bounds[0])
        spec.worldbody.add_geom(
            name=f"obstacle {i}",
            type=kind,
            size=size,
            pos=(*position, 0.5 * HEIGHT),
            quat=(math.cos(0.5 * obstacle.yaw), 0.0, 0.0, math.sin(0.5 * obstacle.yaw)),
            contype=OBSTACLE_BIT,
            conaffinity=0,
        )


def _geom(obstacle: Obstacle, room: float) -> tuple[mujoco.mjtGeom, tuple[float, ...], tuple[float, float]]:
    """Type, MuJoCo's half sizes and centre of one obstacle; `room` is the width that a wall has to close off, m."""
    x, y = obstacle.position
    if obstacle.kind == CYLINDER:
        return mujoco.mjtGeom.mjGEOM_CYLINDER, (obstacle.size[0], 0.5 * HEIGHT, 0.0), (x, y)
    if obstacle.kind == BOX:
        length, width = obstacle.size
        return mujoco.mjtGeom.mjGEOM_BOX, (0.5 * length, 0.5 * width, 0.5 * HEIGHT), (x, y)
    if obstacle.kind == WALL:
        half = 0.5 * THICKNESS
        behind = (x - half * math.cos(obstacle.yaw), y - half * math.sin(obstacle.yaw))
        return mujoco.mjtGeom.mjGEOM_BOX, (half, 0.5 * room + THICKNESS, 0.5 * HEIGHT), behind
    raise ValueError(f"an arena on the ground has no {obstacle.kind}")
