"""Record rollouts to pre-train the rivals: random inputs for SECAS, rollouts that end with braking for SAILR.

No filter protects these rollouts. Their collisions are part of the cost of the rivals.
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

SEED_OFFSET = 5_000_000  # added to the seed, so that training and evaluation use other episodes
POLICIES = ("random", "greedy", "adversary")  # for rollouts that end with braking
STANDING = 2  # periods to observe after the input is zero


@dataclass(frozen=True)
class Transitions:
    """Data for SECAS: observations (N, o), actions (N, m) scaled by the bounds, constraint changes (N, K) in m."""

    observation: Array
    action: Array
    change: Array
    collisions: int


@dataclass(frozen=True)
class Costs:
    """Data for SAILR; costs are in [0, 1].

    braked (N, o), braked_cost (N,): observations during braking, and the cost-to-go under the backup policy.
    driven (M, o + m), step_cost (M,): observation and normalised action of every step, and the cost of the step.
    after (M, o), collided (M,): next observation, and whether the step ended in a collision.
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
    """A running environment that starts a new episode when one ends."""

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
    """Record `samples` steps of random inputs, each held for some periods (Dalal et al. 2018, section 5.1)."""
    drive = _Drive(environment(robot, arena, SEED_OFFSET + seed))
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
    """Record about `samples` steps: repeatedly drive up to `lead` periods, then brake to a stop.

    The cost of a step is max(0, 1 − clearance/smoothing), with smoothing in m; after a collision it stays 1. Sums are
    discounted by γ and scaled by 1 − γ (Wagener et al. 2021, appendix D).
    """
    drive = _Drive(environment(robot, arena, SEED_OFFSET + seed))
    rng = np.random.default_rng((seed, 2))
    drivers = [scripted(name, robot, rng) for name in POLICIES]
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
        """Brake to a stop and store the cost-to-go of each state."""
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
    """Replace the action by a random one half of the time, because the critics must rate any action."""
    return action if rng.random() < 0.5 else rng.uniform(robot.low(), robot.high())


def _braking(robot: RobotWithTask, before: Array) -> Iterator[Array]:
    """Yield the backup policy's inputs to a stop, and then some periods of standing."""
    standing = 0
    while standing < STANDING:
        before = brake(robot, before)
        standing += bool(robot.is_stop_input(before))
        yield before
