"""Drive excitation inputs in the robot's simulator, and record them as a run is recorded.

No filter checks the inputs, for there are no data yet to learn one from: the region keeps the robot safe.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.excitation_plan import Region, RegionExcitation, run_length
from brakeline.deploy.experiments.trials import TrialLog, take_step
from brakeline.deploy.vehicle_factory import empty_arena
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, STEP
from brakeline.sim.arena import Arena
from brakeline.sim.delayed_vehicle import simulated_vehicle
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.sim_conditions import Conditions


@dataclass(frozen=True)
class Driven:
    """Outcome of the driving."""

    path: str
    runs: int
    periods: int
    outside: float  # m, largest true distance of the body beyond the region; negative: it stayed inside by so much
    collisions: int


def drive(
    robot: RobotWithTask,
    region: Region,
    minutes: float,
    seed: int,
    path: Path,
    advance: Callable[[int], Any] = lambda periods: None,
) -> Driven:
    """Drive in runs of a minute, each from rest in the middle of the region, and record the steps into a log.

    Args:
        region: least x, least y, greatest x, greatest y [m].
        advance: is called after each run with its number of periods.

    Raises:
        BadData: the region is too small.
        UnknownTask: the robot has no simulator.
        FileExistsError: `path` exists.
    """
    if path.exists():
        raise FileExistsError(f"{path} is there already: choose another file")
    policy = RegionExcitation(robot, region, np.random.default_rng(seed))

    def draw(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
        return empty_arena(robot, ((region[0] + region[2]) / 2.0, (region[1] + region[3]) / 2.0))

    env = NavigationEnv(robot, make_vehicle=simulated_vehicle(robot, Conditions()), seed_key=seed, draw=draw)
    driver = EpisodeRunner(robot, env, ActorIdentity("excite", 0, seed), filtered=False)
    low, high = np.array(region[:2]) + robot.footprint, np.array(region[2:]) - robot.footprint
    metadata = {
        "run": {"method": "none", "policy": "excitation", "robots": robot.name, "seed": str(seed)},
        "robots": {robot.kind: json.dumps(robot.description)},
    }
    length = run_length(robot)
    runs = max(round(minutes * 60.0 / (length * robot.period)), 1)
    periods, outside, collisions = 0, -np.inf, 0
    with TrialLog(path, metadata) as log:
        for run in range(runs):
            log.put(EPISODE, driver.begin(run))
            before = periods
            while driver.running and periods - before < length:
                step = take_step(driver, policy, None)
                log.put(STEP, step)
                position = np.array(step.true_state[:2])
                periods, collisions = periods + 1, collisions + step.collision
                outside = max(outside, float(np.maximum(low - position, position - high).max()))
            advance(periods - before)
    return Driven(str(path), runs, periods, outside, collisions)
