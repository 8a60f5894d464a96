"""Measure the environment with each robot in steps a second, and its lidar beside casting the rays one by one."""

from __future__ import annotations

from time import perf_counter

import mujoco
import numpy as np

from benchmarks.timing import Figures, timed
from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging.robot import shipped_robots
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.sim.arena import Arena
from brakeline.sim.lidar import Lidar
from brakeline.sim.mujoco_obstacles import HEIGHT, add_obstacles

STEPS = 3000


def run() -> Figures:
    """Return a row for each robot, and one for each way to cast its rays."""
    figures: Figures = {}
    for robot in map(robot_with_task, shipped_robots()):
        figures[f"{robot.name}: environment, lidar included"], arena = _steps(robot)
        figures |= _lidars(robot, arena)
    return figures


def _steps(robot: RobotWithTask) -> tuple[dict[str, float], Arena]:
    """Return the speed with random inputs, and the last arena."""
    env, rng = environment(robot, "default", 0), np.random.default_rng(0)
    seconds, resets, episode, running = 0.0, 0.0, 0, False
    for _ in range(STEPS):
        if not running:
            before = perf_counter()
            env.reset(options={"episode_seed": episode})
            resets += perf_counter() - before
            episode += 1
        action = rng.uniform(robot.low(), robot.high())
        before = perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        seconds += perf_counter() - before
        running = not (terminated or truncated)
    return {"steps/s": STEPS / seconds, "reset ms": 1e3 * resets / episode}, info["arena"]


def map_model(arena: Arena) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile the obstacles of an arena without a robot, to compare a lidar with MuJoCo's rays."""
    spec = mujoco.MjSpec()
    add_obstacles(spec, arena)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def _lidars(robot: RobotWithTask, arena: Arena) -> Figures:
    lidar, origin = Lidar(arena, robot.task.rays), np.asarray(arena.start[: arena.dim])
    model, data = map_model(arena)
    ways = np.zeros((len(robot.task.rays.directions), 3))
    ways[:, : arena.dim] = robot.task.rays.directions
    point = np.array([*origin, 0.5 * HEIGHT][:3])
    hit, normal = np.zeros(1, np.int32), np.zeros(3)

    def one_by_one() -> None:
        for way in ways:
            mujoco.mj_ray(model, data, point, way, None, 1, -1, hit, normal)

    return {
        f"{robot.name}: lidar, ours": timed(lambda: lidar.cast(origin), 2000),
        f"{robot.name}: lidar, mj_ray": timed(one_by_one, 2000),
    }
