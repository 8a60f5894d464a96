"""Drives what the rivals are pre-trained on: random inputs for SECAS, drives that end in braking for SAILR.

Nothing stands between these drives and the obstacles: their collisions are part of what the rivals cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.vehicle_factory import environment
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.braking import brake
from brakeline.safety.rivals.sailr import normalised_input
from brakeline.safety.rivals.secas import Constraints
from brakeline.sim.scripted_policies import Policy, scripted

Array = NDArray[np.float64]

APART = 5_000_000  # added to the seed: neither training nor evaluation draws its episodes from there
DRIVERS = ("random", "greedy", "adversary")  # of the drives that end in braking
STAND = 2  # periods that a stop is watched for after the input has come to zero


@dataclass(frozen=True)
class Transitions:
    """For SECAS: observation (N, o), action (N, m) scaled by the highest inputs, the constraints' change (N, K), m."""

    observation: Array
    action: Array
    change: Array
    collisions: int


@dataclass(frozen=True)
class Costs:
    """For SAILR, with the cost-to-go under the backup policy, in [0, 1].

    Where braking was watched to its end: braked (N, o) observations and their cost (N,). Every step that was driven:
    `driven` (M, o + m), observation and normalised action, the cost of the step itself (M,), what was observed after
    it (M, o), and whether it ended in a collision (M,).
    """

    braked: Array
    braked_cost: Array
    driven: Array
    step_cost: Array
    after: Array
    collided: NDArray[np.bool_]
    collisions: int


@dataclass
class _Drive:
    """An environment under way, begun anew whenever its episode ends."""

    env: Any
    collisions: int = 0
    observation: Any = None
    info: dict[str, Any] = field(default_factory=dict)
    episode: int = -1
    ended: bool = True

    def ready(self) -> None:
        if self.ended:
            self.episode += 1
            self.observation, self.info = self.env.reset(options={"episode_seed": self.episode})
            self.ended = False

    def step(self, action: Array) -> None:
        self.observation, _, terminated, truncated, self.info = self.env.step(action)
        self.ended = terminated or truncated
        self.collisions += self.info["collision"]


def transitions(
    robot: RobotWithTask, arena: str, samples: int, seed: int, each: Callable[[], object] = lambda: None
) -> Transitions:
    """`samples` steps of random inputs, each held for some periods (Dalal et al. 2018, section 5.1)."""
    drive = _Drive(environment(robot, arena, APART + seed))
    policy = scripted("random", robot, np.random.default_rng((seed, 1)))
    constraints = Constraints(robot, robot.task.rays)
    rows: list[tuple[Any, Array, Array]] = []
    while len(rows) < samples:
        drive.ready()
        seen, before = drive.observation, constraints(drive.observation, drive.info["state"])
        drive.step(policy(seen, drive.info))
        executed = np.asarray(drive.info["input_in_force"]) / robot.high()
        rows.append((seen, executed, constraints(drive.observation, drive.info["state"]) - before))
        each()
    seen, inputs, changes = (np.array([row[i] for row in rows], float) for i in range(3))
    return Transitions(seen, inputs, changes, drive.collisions)


def costs(
    robot: RobotWithTask,
    arena: str,
    samples: int,
    seed: int,
    gamma: float,
    smoothing: float,
    lead: int,
    each: Callable[[], object] = lambda: None,
) -> Costs:
    """About `samples` steps: up to `lead` periods of driving, then braking to a stop, and again (Wagener et al. 2021,
    appendix D).

    A step costs max(0, 1 − clearance/smoothing), smoothing in m, and a collision 1 for ever; sums are discounted by γ
    and scaled by 1 − γ.
    """
    drive = _Drive(environment(robot, arena, APART + seed))
    rng = np.random.default_rng((seed, 2))
    drivers = [scripted(name, robot, rng) for name in DRIVERS]
    braked: list[tuple[Any, float]] = []
    driven: list[tuple[Array, float, Any, bool]] = []

    def cost() -> float:
        return 1.0 if drive.info["collision"] else max(0.0, 1.0 - max(drive.info["clearance"], 0.0) / smoothing)

    def take(action: Array) -> None:
        seen = drive.observation
        drive.step(action)
        pair = np.concatenate([seen, normalised_input(robot, np.asarray(drive.info["input_in_force"]))])
        driven.append((pair, (1.0 - gamma) * cost(), drive.observation, bool(drive.info["collision"])))
        each()

    def stop() -> None:
        """Brake, and say what it came to from each of its states."""
        seen, spent = [], []
        for action in _braking(robot, np.asarray(drive.info["input_in_force"])):
            seen.append(drive.observation)
            take(action)
            spent.append(cost())
            if drive.ended:
                break
        to_go = 0.0
        if drive.info["collision"]:
            spent[-1] = 1.0 / (1.0 - gamma)
        for observation, amount in zip(reversed(seen), reversed(spent), strict=True):
            to_go = amount + gamma * to_go
            braked.append((observation, (1.0 - gamma) * to_go))

    while len(driven) < samples:
        drive.ready()
        policy: Policy = drivers[int(rng.integers(len(drivers)))]
        for _ in range(int(rng.integers(lead + 1))):
            if not drive.ended:
                take(_varied(robot, policy(drive.observation, drive.info), rng))
        if not drive.ended:
            stop()
    states, to_go = (np.array([row[i] for row in braked], float) for i in range(2))
    pairs, step, after = (np.array([row[i] for row in driven], float) for i in range(3))
    return Costs(states, to_go, pairs, step, after, np.array([row[3] for row in driven]), drive.collisions)


def _varied(robot: RobotWithTask, action: Array, rng: np.random.Generator) -> Array:
    """Half of the time another action instead: the critics are asked about every one."""
    return action if rng.random() < 0.5 else rng.uniform(robot.low(), robot.high())


def _braking(robot: RobotWithTask, before: Array) -> Iterator[Array]:
    """The backup policy's inputs to a stop, and some periods of standing."""
    standing = 0
    while standing < STAND:
        before = brake(robot, before)
        standing += bool(robot.is_stop_input(before))
        yield before
