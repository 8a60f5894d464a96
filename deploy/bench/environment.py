"""Steps a second of the environment; its lidar beside MuJoCo's own ray casting."""

from __future__ import annotations

from time import perf_counter

import mujoco
import numpy as np

from deploy.bench.timing import Figures, timed
from deploy.vehicles import environment
from messaging.robots import GROUND, RAYS
from sim.lidar import cast
from sim.scene import add_obstacles

STEPS = 3000


def run() -> Figures:
    env = environment(GROUND, "default", 0)
    rng = np.random.default_rng(0)
    seconds, resets, episode = 0.0, 0.0, 0
    running = False
    for _ in range(STEPS):
        if not running:
            before = perf_counter()
            env.reset(options={"episode_seed": episode})
            resets += perf_counter() - before
            episode += 1
        action = rng.uniform(GROUND.low(), GROUND.high())
        before = perf_counter()
        _, _, terminated, truncated, info = env.step(action)
        seconds += perf_counter() - before
        running = not (terminated or truncated)
    arena = info["arena"]
    spec = mujoco.MjSpec()
    add_obstacles(spec, arena)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    angles = np.linspace(-np.pi / 2, np.pi / 2, RAYS)
    point = np.array([*arena.start[:2], 0.1])
    ways = [np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    hit, normal = np.zeros(1, np.int32), np.zeros(3)

    def by_mujoco() -> None:
        for way in ways:
            mujoco.mj_ray(model, data, point, way, None, 1, -1, hit, normal)

    position = np.asarray(arena.start[:2])
    return {
        "environment, lidar included": {"steps/s": STEPS / seconds, "reset ms": 1e3 * resets / episode},
        "lidar, ours": timed(lambda: cast(arena.shapes, position, 0.0), 2000),
        "lidar, mj_ray": timed(by_mujoco, 2000),
    }
