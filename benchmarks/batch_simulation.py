"""Time many simulated robots at once beside single environments and SyncVectorEnv, with the filter and without it.

All ways drive the same arenas with the same policy. Each ratio is of two times of the same block, and the interval is
of all blocks. The time of the processor counts, over all threads, so other processes disturb little. The plot is
`docs/figures/batch_simulation.svg`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from benchmarks.timing import Figures, spread_of
from brakeline.deploy.interpreter import spawning
from brakeline.deploy.policy_loading import TRAINED, network_named
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.gym_vector import VectorSafetyWrapper
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.navigation_env import NavigationEnv

PLOT = Path(__file__).parents[1] / "docs" / "figures" / "batch_simulation.svg"
SIZES = {"ground": (1, 4, 16, 64, 256, 1024), "quadrotor": (1, 16, 64, 256)}
STEPS, BLOCKS = 1024, 5  # robot steps of a block, at least two periods of a batch
PLAIN_SIZES, PEERS = (64, 256), 16
PROCESSES, LARGE, SECONDS = 2, 256, 20.0  # of the row by the clock

Act = Callable[[], None]  # one period of all robots


def run() -> Figures:
    """Return a row for each number of robots at once, with its peer in the same blocks."""
    figures: Figures = {}
    for name, sizes in SIZES.items():
        robot = robot_with_task(name)
        alone, single, vector = _single(robot, filtered=False), _single(robot, filtered=True), _vector(robot, PEERS)
        for size in sizes:
            batch = _filtered(robot, size)
            figures[f"{name}, filtered, {size} robots: beside one"] = beside(size, batch, single)
            if size in PLAIN_SIZES:
                figures[f"{name}, filtered, {size} robots: beside SyncVectorEnv of {PEERS}"] = beside(
                    size, batch, vector, PEERS
                )
                plain = _driven(BatchNavigationEnv(robot, size), robot)
                figures[f"{name}, no filter, {size} robots: beside one"] = beside(size, plain, alone)
        figures[f"{name}, filtered, {PROCESSES} processes of {LARGE} robots: by the clock"] = by_the_clock(name)
    _draw({name: {n: figures[f"{name}, filtered, {n} robots: beside one"] for n in SIZES[name]} for name in SIZES})
    return figures


def by_the_clock(name: str) -> dict[str, float]:
    """Return the filtered robot steps a second of some processes together, each with a batch of its own."""
    with ProcessPoolExecutor(PROCESSES, spawning()) as pool:
        rates = list(pool.map(_rate, [name] * PROCESSES))
    return {"batch steps/s": sum(rates)}


def _rate(name: str) -> float:
    """Return the robot steps a second of one process, by the clock. The others begin within a second or two."""
    act = _filtered(robot_with_task(name), LARGE)
    for _ in range(5):
        act()
    started, periods = perf_counter(), 0
    while perf_counter() - started < SECONDS:
        act()
        periods += 1
    return periods * LARGE / (perf_counter() - started)


def _draw(rows: dict[str, dict[int, dict[str, float]]]) -> None:
    """Draw the filtered steps for each second of processor time against the number of robots, beside one robot."""
    from matplotlib import pyplot

    pyplot.rcParams["svg.hashsalt"] = PLOT.name  # the same figures give the same file
    figure, axes = pyplot.subplots(figsize=(6.0, 3.2), layout="constrained")
    for number, (robot, sizes) in enumerate(rows.items()):
        for name, label, style in (("batch steps/s", "many at once", "o-"), ("peer steps/s", "one at a time", "s--")):
            steps = [row[name] for row in sizes.values()]
            axes.plot(list(sizes), steps, style, color=f"C{number}", label=f"{robot}, {label}")
    axes.set_xscale("log", base=2)
    ticks = sorted({size for sizes in rows.values() for size in sizes})
    axes.set_xticks(ticks, list(map(str, ticks)))
    axes.set(ylim=(0.0, None), xlabel="robots in the batch", ylabel="filtered steps for each\nsecond of processor time")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(PLOT, metadata={"Date": None})


def beside(size: int, batch: Act, peer: Act, peer_size: int = 1) -> dict[str, float]:
    """Return robot steps a second of processor time of a batch and its peer, and their ratio with its interval."""
    for act in (batch, batch, peer):
        act()
    costs = np.array([(_cost(batch, size), _cost(peer, peer_size)) for _ in range(BLOCKS)])
    batch_cost, peer_cost = costs.min(axis=0).tolist()
    rates = {"batch steps/s": 1.0 / batch_cost, "peer steps/s": 1.0 / peer_cost}
    return rates | spread_of(costs[:, 1] / costs[:, 0])


def _cost(act: Act, size: int) -> float:
    """Return the processor time of one robot step [s]."""
    periods = max(2, STEPS // (4 if size == 1 else 1) // size)
    before = process_time()
    for _ in range(periods):
        act()
    return (process_time() - before) / (periods * size)


def _filtered(robot: RobotWithTask, size: int) -> Act:
    """Return a period of `size` robots of a batch behind the filter."""
    env = BatchSafetyWrapper(BatchNavigationEnv(robot, size), Filter.load(robot.name))
    return _driven(env, robot)


def _vector(robot: RobotWithTask, size: int) -> Act:
    """Return a period of `size` robots of a `SyncVectorEnv` behind the filter."""
    env = SyncVectorEnv([lambda: NavigationEnv(robot)] * size, autoreset_mode=AutoresetMode.SAME_STEP)
    return _driven(VectorSafetyWrapper(env, Filter.load(robot.name)), robot)


def _driven(env: VectorEnv[Any, Any, Any], robot: RobotWithTask) -> Act:
    """Return a period of all robots of a vector environment, with the trained policy and exploration."""
    policy, rng = network_named(TRAINED, robot, 0), np.random.default_rng(0)
    observations, _ = env.reset(seed=0)

    def act() -> None:
        nonlocal observations
        noise = 0.1 * rng.standard_normal((env.num_envs, robot.action_dim))
        observations = env.step(policy.of_many(observations, noise))[0]

    return act


def _single(robot: RobotWithTask, filtered: bool) -> Act:
    """Return a period of one robot in `NavigationEnv`, which begins the next episode at the end of one."""
    env: gymnasium.Env[Any, Any] = NavigationEnv(robot)
    env = SafetyWrapper(env, Filter.load(robot.name)) if filtered else env
    policy, rng = network_named(TRAINED, robot, 0), np.random.default_rng(0)
    observation, _ = env.reset(seed=0)

    def act() -> None:
        nonlocal observation
        observation, _, terminated, truncated, _ = env.step(policy.explore(observation, rng))
        if terminated or truncated:
            observation, _ = env.reset()

    return act
