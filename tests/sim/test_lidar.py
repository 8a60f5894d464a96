"""MuJoCo's geoms have the distances of the shapes, and our ranges, of one robot or many, are those of MuJoCo's rays."""

import mujoco
import numpy as np
import pytest

from benchmarks.environment_speed import map_model
from brakeline.messaging.obstacle import CYLINDER, SPHERE, WALL, Obstacle, Shapes, rotate
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.task import RobotWithTask
from brakeline.sim.arena import Arena
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.batch.obstacle_batch import ObstacleBatch
from brakeline.sim.lidar import Lidar
from brakeline.sim.mujoco_obstacles import HEIGHT, add_obstacles
from tests.arenas import staged_arena
from tests.robots import GROUND, QUADROTOR

PLANE, SPACE = GROUND.task.rays, QUADROTOR.task.rays
REACH = 3.0  # m
SAME = 1e-9  # rounding


def geom_distances(arena: Arena, points: np.ndarray) -> np.ndarray:
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
    ("robot", "name", "heights"), [(QUADROTOR, "dense", ()), (GROUND, "dense", (0.01, HEIGHT - 0.01))]
)
def test_geoms_have_the_distances_of_their_shapes(robot: RobotWithTask, name: str, heights: tuple[float, ...]) -> None:
    """In the plane, geoms stand on the floor: the distance is the same at every height."""
    arena = draw_arena(name, np.random.default_rng(4), robot)
    low, high = np.array(arena.bounds).T
    points = np.random.default_rng(0).uniform(low, high, (60, arena.dim))
    exact = arena.shapes.distance(points)
    points, exact = points[exact.min(axis=0) > 0.0], exact[:, exact.min(axis=0) > 0.0]
    for at in [np.column_stack((points, np.full(len(points), height))) for height in heights] or [points]:
        assert geom_distances(arena, at) == pytest.approx(np.minimum(exact, REACH + 1e-3), abs=2e-3)
    with pytest.raises(ValueError, match="no sphere"):
        add_obstacles(mujoco.MjSpec(), staged_arena(Obstacle(SPHERE, (0.0, 1.0), (0.5,))))


def mujoco_ranges(arena: Arena, rays: LidarRays, origin: np.ndarray, heading: float) -> np.ndarray:
    """Return the ranges (R,) [m] from a point (d,) by one ray of MuJoCo after the other: the kernel's twin."""
    model, data = map_model(arena)
    point, beams = np.full(3, 0.5 * HEIGHT), np.zeros((len(rays.directions), 3))
    point[: arena.dim], beams[:, : arena.dim] = origin, rotate(rays.directions, heading)
    hit = np.zeros(1, np.int32)
    ranges = np.array([mujoco.mj_ray(model, data, point, beam, None, 1, -1, hit, None) for beam in beams])
    return np.minimum(np.where(ranges < 0.0, rays.range, ranges), rays.range)


@pytest.mark.parametrize(("robot", "arena"), [(GROUND, "dense"), (GROUND, "open"), (QUADROTOR, "dense")])
def test_ranges_are_those_of_mujoco(robot: RobotWithTask, arena: str) -> None:
    """Within 1e-9, from random points and headings, also from inside an obstacle."""
    rng, rays, kind = np.random.default_rng(0), robot.task.rays, robot.task.arenas[arena]
    arenas = [draw_arena(arena, rng, robot) for _ in range(8)]
    batch, d = ObstacleBatch(8, kind), robot.position_dim
    for row, one in enumerate(arenas):
        batch.put(row, one)
    low, high = np.array(arenas[0].bounds).T
    rows, points = np.arange(8), rng.uniform(low + 0.1, high - 0.1, (8, d))
    for turn in rng.uniform(-np.pi, np.pi, 5):
        beams = np.tile(rotate(rays.directions, turn), (8, 1, 1))
        ranges = batch.cast(rows, points, beams, rays.range)
        for row, one in enumerate(arenas):
            assert np.abs(ranges[row] - mujoco_ranges(one, rays, points[row], turn)).max() <= SAME
            assert (ranges[row] == Lidar(one, rays).cast(points[row], turn)).all()
    clear = [Shapes.of(one.obstacles, d).distance(points[row]).min() for row, one in enumerate(arenas)]
    assert np.abs(batch.clearance(rows, points[:, None])[:, 0] - clear).max() <= SAME


def test_ranges_in_the_plane_are_exact() -> None:
    arena = staged_arena(Obstacle(WALL, (2.0, 0.0), yaw=np.pi), Obstacle(CYLINDER, (0.0, -1.0), (0.25,)))
    ranges = Lidar(arena, PLANE).cast(np.zeros(2))
    assert ranges[0] == pytest.approx(0.75)  # the first ray points to the right
    assert ranges[-1] == PLANE.range
    assert ranges[9] == pytest.approx(2.0 / PLANE.directions[9, 0])


def test_ranges_in_space_are_exact() -> None:
    ball = Obstacle(SPHERE, (0.0, 6.0, 3.0), (1.5,))
    lidar = Lidar(staged_arena(ball, goal=(9.0, 9.0, 3.0), half_width=10.0, height=8.0), SPACE)
    ranges = lidar.cast(np.array([0.0, 0.0, 3.0])).reshape(36, 5)  # azimuths from ahead to the left, elevations upwards
    assert ranges[0, 2] == pytest.approx(10.0)  # the wall ahead
    assert ranges[9, 2] == pytest.approx(4.5)  # the ball to the left
    assert ranges[27, 0] == pytest.approx(6.0)  # 30° down to the floor
    assert ranges[27, 4] == pytest.approx(10.0)  # 30° up to the ceiling, 5 m above
    assert lidar.cast(np.array([0.0, -9.0, 3.0])).reshape(36, 5)[9, 2] == SPACE.range


def test_noise_is_cut_off_and_only_on_beams_that_hit() -> None:
    arena = staged_arena(goal=(9.0, 9.0, 3.0), half_width=20.0, height=30.0)
    origin = np.array([12.0, 0.0, 3.0])
    true = Lidar(arena, SPACE).cast(origin)
    noisy = Lidar(arena, SPACE, 0.02, np.random.default_rng(0)).ranges(origin)
    hit = true < SPACE.range
    assert 20 < hit.sum() < 160
    assert (noisy[~hit] == SPACE.range).all()
    error = noisy[hit] - true[hit]
    assert 0.012 < error.std() < 0.02 and np.abs(error).max() <= 0.04 + 1e-12
    assert noisy.max() <= SPACE.range
    close = Lidar(arena, SPACE, 0.02, np.random.default_rng(0)).ranges(np.array([19.99, 0.0, 3.0]))
    assert close.min() == 0.0
    assert (Lidar(arena, SPACE).ranges(origin) == true).all()
