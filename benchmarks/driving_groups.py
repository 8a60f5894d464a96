"""Share of plans and of steps outside the sets of the shipped robots, by who drives, beside what is stated.

The model sets are those of mode one-step in the data folder; missing ones are recorded and certified first. Each group
drives behind the filter in fresh episodes: the plans do not overlap, and no set is widened while they last.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.timing import Figures
from brakeline.actors.episode_runner import EpisodeRunner
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import Evaluation, in_process, prepare_evaluation
from brakeline.deploy.progress import console, under_way
from brakeline.logs.proportion_intervals import clopper_pearson
from brakeline.messaging.obstacle import Array
from brakeline.messaging.stated_share import CONFIDENCE
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.model.driving_kinds import JUMPING, START
from brakeline.safety.model.model_config import ONE_STEP, ModelConfig
from brakeline.safety.model.model_set import ModelSet
from brakeline.sim.scripted_policies import Observation, Policy

ROBOTS = ("ground", "quadrotor")
PLANS = 2500  # of each group
FIRST = "first period after a reset"
GROUPS = {"random": "random", "adversary": "adversary", "trained": "trained", JUMPING: "random", FIRST: "random"}
SEED = 7
MOST_HELD = 3  # periods between two jumps


class JumpingPolicy:
    """Sets every input to one of its bounds, anew after one to three periods."""

    def __init__(self, robot: RobotWithTask, rng: np.random.Generator) -> None:
        self._robot, self._rng, self._left = robot, rng, 0

    def __call__(self, observation: Observation, info: dict[str, Any]) -> Array:
        if self._left == 0:
            self._left = int(self._rng.integers(1, MOST_HELD, endpoint=True))
            low, high = self._robot.low(), self._robot.high()
            self._input = np.where(self._rng.random(len(low)) < 0.5, low, high)
        self._left -= 1
        return self._input


@dataclass
class Containment:
    """Counts of one group: plans and steps, how many were outside, and the largest score of a plan."""

    plans: int = 0
    plans_outside: int = 0
    steps: int = 0
    steps_outside: int = 0
    largest: float = 0.0

    def plan(self, score: float) -> None:
        """Add a plan: the largest ratio of an error to its set."""
        self.plans += 1
        self.plans_outside += not score <= 1.0
        self.largest = max(self.largest, score)

    def step(self, contained: bool) -> None:
        self.steps += 1
        self.steps_outside += not contained

    def figures(self, model: ModelSet, kind: str = "") -> dict[str, float]:
        """Return the shares [%] beside the stated bounds, and what the counts show with confidence.

        kind: the kind of driving whose row states the bounds; by default those of all driving.
        """
        plan, step = (float(model.about[f"bound_{part} {kind}".strip()]) for part in ("plan", "step"))
        return {
            "plans": self.plans,
            "plans outside": self.plans_outside,
            "plans [%]": 100.0 * self.plans_outside / max(self.plans, 1),
            "plans, at least [%]": 100.0 * lower_bound(self.plans_outside, self.plans),
            "plans, stated at most [%]": 100.0 * plan,
            "steps": self.steps,
            "steps outside": self.steps_outside,
            "steps [%]": 100.0 * self.steps_outside / max(self.steps, 1),
            "steps, at least [%]": 100.0 * lower_bound(self.steps_outside, self.steps),
            "steps, stated at most [%]": 100.0 * step,
            "largest error [% of its set]": 100.0 * self.largest,
        }


def lower_bound(outside: int, count: int) -> float:
    """Return the lower Clopper-Pearson bound on the probability of being outside, at 99 % confidence."""
    low, _ = clopper_pearson(outside, count, 2.0 * CONFIDENCE - 1.0) or (0.0, 1.0)
    return low


def drive(driver: EpisodeRunner, policy: Policy, ask: Any, longest: int) -> Iterator[tuple[float | None, bool]]:
    """Yield the score of the window that ended and whether the step stayed in its set, over episodes without end.

    longest: periods of an episode; 0: until its end.
    """
    episode = 0
    while True:
        driver.begin(episode)
        while driver.running and not (longest and driver.step >= longest):
            driver.backup_plan.widening.forget()  # the stated sets count, not the widened ones
            proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
            outcome = driver.decide(proposal, ask)
            assert outcome is not None and outcome.answer is not None, outcome and outcome.failure
            step = driver.execute(proposal, outcome)
            yield outcome.answer.score, step.contained
        episode += 1


def contained(robot: RobotWithTask, model: ModelSet, group: str, plans: int) -> Containment:
    """Drive one group until `plans` plans have ended."""
    driver, policy, _ = prepare_evaluation(robot, Evaluation(GROUPS[group], "none", seed=SEED))
    if group == JUMPING:
        policy = JumpingPolicy(robot, np.random.default_rng(SEED))
    counts, N = Containment(), robot.horizon
    for score, inside in drive(driver, policy, in_process(model, 1.0), N + 1 if group == FIRST else 0):
        first = driver.step == 1  # the step that has just ended was the episode's first one
        if group != FIRST or first:
            counts.step(inside)
        if score is not None and (driver.step - 1) % N == 0:
            counts.plan(score)
            if counts.plans >= plans:
                return counts
    raise AssertionError("driving has no end")


def run(plans: int = PLANS) -> Figures:
    """Drive every group of each robot."""
    rows = {}
    for name in ROBOTS:
        robot = robot_with_task(name)
        model = model_for(robot, ModelConfig(mode=ONE_STEP))
        for group in GROUPS:
            with under_way(f"{name}: {group}"):
                counts = contained(robot, model, group, plans)
            kind = {JUMPING: JUMPING, FIRST: START}.get(group, "")
            rows[f"{name}: {group}"] = counts.figures(model, kind)
            console.print(f"{name}: {group}: {counts.plans_outside} of {counts.plans} plans outside", markup=False)
    return rows
