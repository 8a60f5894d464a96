"""Record rollouts to pre-train the rivals: random inputs for SECAS, rollouts that end with braking for SAILR.

No filter protects these rollouts. Their collisions are part of the cost of the rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.deploy.vehicle_factory import environment
from brakeline.learner.rival_networks import FitConfig
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.filter.backup_plan import brake
from brakeline.safety.rivals.sailr import normalised_input
from brakeline.safety.rivals.secas import Constraints
from brakeline.sim.scripted_policies import Policy, scripted

AfterStep = Callable[[], object]

SEED_OFFSET = 5_000_000  # added to the seed, so that training and evaluation use other episodes
POLICIES = ("random", "greedy", "adversary")  # for rollouts that end with braking
STANDING = 2  # periods to observe after the input is zero


@dataclass(frozen=True)
class SecasConfig:
    """Configuration of SECAS. Dalal et al. use one hidden layer of 10 units, Adam at 1e-4, 1000 random episodes."""

    samples: int = 40_000
    arena: str = "default"
    seed: int = 20_261
    fit: FitConfig = field(default_factory=lambda: FitConfig(hidden=(64, 64)))
    margin: float = 0.1  # m added to the footprint: the bound C, tuned


@dataclass(frozen=True)
class SailrConfig:
    """Configuration of SAILR. Wagener et al. use three layers of 256, Adam at 1e-3, γ 0.99, smoothing 0.5, η 0.08."""

    samples: int = 80_000
    arena: str = "default"
    seed: int = 20_262
    fit: FitConfig = field(default_factory=lambda: FitConfig(hidden=(256, 256, 256), epochs=10))
    gamma: float = 0.99
    smoothing: float = 0.5  # m of clearance
    threshold: float = 0.08  # η, tuned
    lead: int = 5  # largest number of periods before braking


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


class _Drive:
    """A running environment that starts a new episode when one ends."""

    def __init__(self, robot: RobotWithTask, config: SecasConfig | SailrConfig, after_step: AfterStep) -> None:
        self._env = environment(robot, config.arena, SEED_OFFSET + config.seed)
        self._each, self._episode = after_step, -1
        self.observation: Any = None
        self.info: dict[str, Any] = {}
        self.ended, self.collisions = True, 0

    def ready(self) -> None:
        """Begin an episode if the last one has ended."""
        if self.ended:
            self._episode += 1
            self.observation, self.info = self._env.reset(options={"episode_seed": self._episode})
            self.ended = False

    def step(self, action: Array) -> Array:
        """Drive one period, and return the input in force in it."""
        self.observation, _, terminated, truncated, self.info = self._env.step(action)
        self.ended = terminated or truncated
        self.collisions += self.info["collision"]
        self._each()
        return np.asarray(self.info["input_in_force"])


def transitions(robot: RobotWithTask, config: SecasConfig, after_step: AfterStep = lambda: None) -> Transitions:
    """Record `samples` steps of random inputs, each held for some periods (Dalal et al. 2018, section 5.1)."""
    drive = _Drive(robot, config, after_step)
    policy = scripted("random", robot, np.random.default_rng((config.seed, 1)))
    constraints = Constraints(robot, robot.task.rays)
    rows: list[tuple[Any, Array, Array]] = []
    while len(rows) < config.samples:
        drive.ready()
        seen, before = drive.observation, constraints(drive.observation, drive.info["state"])
        executed = drive.step(policy(seen, drive.info)) / robot.high()
        rows.append((seen, executed, constraints(drive.observation, drive.info["state"]) - before))
    seen, inputs, changes = _columns(rows)
    return Transitions(seen, inputs, changes, drive.collisions)


def costs(robot: RobotWithTask, config: SailrConfig, after_step: AfterStep = lambda: None) -> Costs:
    """Record about `samples` steps: repeatedly drive up to `lead` periods, then brake to a stop.

    The cost of a step is max(0, 1 − clearance/smoothing), with smoothing in m; after a collision it stays 1. Sums are
    discounted by γ and scaled by 1 − γ (Wagener et al. 2021, appendix D).
    """
    drive, gamma = _Drive(robot, config, after_step), config.gamma
    rng = np.random.default_rng((config.seed, 2))
    drivers = [scripted(name, robot, rng) for name in POLICIES]
    braked: list[tuple[Any, float]] = []
    driven: list[tuple[Array, float, Any, bool]] = []

    def take(action: Array) -> float:
        """Drive one period, and return its cost."""
        seen = drive.observation
        pair = np.concatenate([seen, normalised_input(robot, drive.step(action))])
        collided = bool(drive.info["collision"])
        cost = 1.0 if collided else max(0.0, 1.0 - max(drive.info["clearance"], 0.0) / config.smoothing)
        driven.append((pair, (1.0 - gamma) * cost, drive.observation, collided))
        return cost

    def stop() -> None:
        """Brake to a stop and store the cost-to-go of each state."""
        seen, spent = [], []
        for action in _braking(robot, np.asarray(drive.info["input_in_force"])):
            seen.append(drive.observation)
            spent.append(take(action))
            if drive.ended:
                break
        if drive.info["collision"]:
            spent[-1] = 1.0 / (1.0 - gamma)
        to_go = 0.0
        for observation, amount in zip(reversed(seen), reversed(spent), strict=True):
            to_go = amount + gamma * to_go
            braked.append((observation, (1.0 - gamma) * to_go))

    while len(driven) < config.samples:
        drive.ready()
        policy: Policy = drivers[int(rng.integers(len(drivers)))]
        for _ in range(int(rng.integers(config.lead + 1))):
            if not drive.ended:
                action = policy(drive.observation, drive.info)
                # Replace half of the actions by random ones, because the critics must rate any action.
                take(action if rng.random() < 0.5 else rng.uniform(robot.low(), robot.high()))
        if not drive.ended:
            stop()
    states, to_go = _columns(braked)
    pairs, step, after, collided = _columns(driven)
    return Costs(states, to_go, pairs, step, after, collided.astype(bool), drive.collisions)


def _columns(rows: Sequence[tuple[Any, ...]]) -> list[Array]:
    return [np.array(values, float) for values in zip(*rows, strict=True)]


def _braking(robot: RobotWithTask, before: Array) -> Iterator[Array]:
    """Yield the backup policy's inputs to a stop, and then some periods of standing."""
    standing = 0
    while standing < STANDING:
        before = brake(robot, before)
        standing += bool(robot.is_stop_input(before))
        yield before
