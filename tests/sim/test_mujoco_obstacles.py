"""The geoms of obstacles have the distances of `brakeline.messaging.obstacle`."""

import mujoco
import numpy as np
import pytest

from brakeline.messaging.obstacle import SPHERE, Obstacle
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.mujoco_obstacles import HEIGHT, add_obstacles
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

REACH = 3.0  # m


def distances(arena: Arena, points: np.ndarray) -> np.ndarray:
    """Return MuJoCo's distances (n, p) from points (p, 3) to the geoms of the obstacles, at most `REACH`."""
    spec = mujoco.MjSpec()
    add_obstacles(spec, arena)
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(1e-3, 0.0, 0.0))
    model = spec.compile()
    data = mujoco.MjData(model)
    geoms = [model.geom(f"obstacle {i}").id for i in range(len(arena.obstacles))]
    measured = np.empty((len(geoms), len(points)))
    for j, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        for i, geom in enumerate(geoms):
            measured[i, j] = mujoco.mj_geomDistance(model, data, geom, model.geom("probe").id, REACH, None) + 1e-3
    return measured


@pytest.mark.parametrize(
    ("robot", "name", "heights"),
    [(QUADROTOR, name, ()) for name in ("default", "dense", "tall")] + [(GROUND, "dense", (0.01, HEIGHT - 0.01))],
)
def test_geoms_have_the_distances_of_their_shapes(robot: Robot, name: str, heights: tuple[float, ...]) -> None:
    """In the plane, geoms stand on the floor: the distance is the same at every height."""
    arena = draw_arena(name, np.random.default_rng(4), robot)
    low, high = np.array(arena.bounds).T
    points = np.random.default_rng(0).uniform(low, high, (60, arena.dim))
    exact = arena.shapes.distance(points)
    points, exact = points[exact.min(axis=0) > 0.0], exact[:, exact.min(axis=0) > 0.0]
    for at in [np.column_stack((points, np.full(len(points), height))) for height in heights] or [points]:
        assert distances(arena, at) == pytest.approx(np.minimum(exact, REACH + 1e-3), abs=2e-3)


def test_a_sphere_in_the_plane_is_refused() -> None:
    with pytest.raises(ValueError, match="no sphere"):
        add_obstacles(mujoco.MjSpec(), staged_arena(Obstacle(SPHERE, (0.0, 1.0), (0.5,))))
