"""`brakeline excite --drive`: excitation by the actor's own driver, in the robot's simulator, recorded as a run is.

There is no filter before it, for there are no data yet to make one of: the region is what keeps the robot safe.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.excitation_plan import Excited, Keep, run_length
from brakeline.deploy.experiments.trials import TrialLog, one_step, thinking
from brakeline.deploy.vehicle_factory import YARD, factory
from brakeline.messaging.task import RobotWithTask
from brakeline.messaging.topics import EPISODE, STEP
from brakeline.sim.arena import Arena, room_boundary, room_bounds
from brakeline.sim.navigation_env import NavigationEnv
from brakeline.sim.sim_conditions import Conditions


@dataclass(frozen=True)
class Driven:
    """outside [m]: how far the body, in truth, was beyond the region at most; below 0: so near it came to the edge."""

    path: str
    runs: int
    periods: int
    outside: float
    collisions: int


def drive(
    robot: RobotWithTask,
    keep: Keep,
    minutes: float,
    seed: int,
    path: Path,
    conditions: Conditions | None = None,
    each: Callable[[int], Any] = lambda periods: None,
) -> Driven:
    """Drive that long in runs of a minute, each from rest in the region's middle, and record the steps into a log.

    Raises:
        BadData: the region has no room; UnknownTask: the robot has no simulator; FileExistsError: `path` is there.
    """
    if path.exists():
        raise FileExistsError(f"{path} is there already")
    policy = Excited(robot, keep, np.random.default_rng(seed))
    env = NavigationEnv(robot, make_vehicle=factory(robot, conditions or Conditions()), seed_key=seed, draw=_yard(keep))
    driver = EpisodeRunner(robot, env, ActorIdentity("excite", 0, seed), filtered=False)
    low, high = np.array(keep[:2]) + robot.footprint, np.array(keep[2:]) - robot.footprint
    about = {
        "run": {"method": "none", "policy": "excitation", "robots": robot.name, "seed": str(seed)},
        "robots": {robot.kind: json.dumps(robot.description)},
    }
    runs = max(round(minutes * 60.0 / (run_length(robot) * robot.period)), 1)
    periods, outside, collisions = 0, -np.inf, 0
    with TrialLog(path, about) as log:
        for run in range(runs):
            log.put(EPISODE, driver.begin(run))
            for _ in range(run_length(robot)):
                step = one_step(driver, thinking(policy), None)
                log.put(STEP, step)
                there = np.array(step.true_state[:2])
                periods, collisions = periods + 1, collisions + step.collision
                outside = max(outside, float(np.maximum(low - there, there - high).max()))
                if not driver.running:
                    break
            each(periods)
    return Driven(str(path), runs, periods, outside, collisions)


def _yard(keep: Keep) -> Callable[[str, np.random.Generator, RobotWithTask], Arena]:
    """A place with nothing in it; the start is the region's middle, along x, the goal out of reach."""
    middle = ((keep[0] + keep[2]) / 2.0, (keep[1] + keep[3]) / 2.0)

    def draw(name: str, rng: np.random.Generator, robot: RobotWithTask) -> Arena:
        half = YARD[robot.position_dim]
        height = None if robot.position_dim == 2 else 2.0 * half
        up = (0.0,) if height is None else (half,)
        goal = (0.9 * half, 0.9 * half, *(() if height is None else up))
        return Arena("yard", room_boundary(half, height), (*middle, *up), goal, 0.25, 10**9, room_bounds(half, height))

    return draw
