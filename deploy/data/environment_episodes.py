"""Record a data set in a Gymnasium environment, with excitation as the policy.

data = collect(env, robot, periods=30_000, state=state, actions=normalised(robot))
model, statement = certify(data, ModelConfig())
env = SafetyWrapper(env, Filter(model), state=state, obstacles=obstacles, actions=normalised(robot))
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from brakeline.deploy.data.excitation import MOST_HELD, excitation
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.deploy.progress import Advance, under_way
from brakeline.errors import BadData
from brakeline.messaging.acceleration_age import ENTRY, about_age
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.action_mapping import ActionMapping, action_for, mapping_for_space
from brakeline.safety.environment_views import STATE, View
from brakeline.safety.model.dataset import Dataset, Trajectory, bends
from brakeline.safety.model.repeated_driving import without_repeats
from brakeline.safety.model.windows import displacement

FEWEST = 3  # periods; shorter trajectories are dropped
LONGEST = 300  # periods per trajectory; then the environment is reset
MAX_EMPTY = 1000  # consecutive episodes without a trajectory


def collect(
    env: gymnasium.Env[Any, Any],
    robot: Robot,
    periods: int = 30_000,
    *,
    seed: int = 0,
    held: int = MOST_HELD,
    state: View = STATE,
    actions: ActionMapping | None = None,
    disturbed: Callable[[Any, Any, dict[str, Any]], bool] = lambda env, observation, info: False,
    chord_deviation: float | None = None,
    options: dict[str, Any] | None = None,
    shown: bool = True,
) -> Dataset:
    """Drive the environment with `excitation` until `periods` periods are recorded. A period is one `step`.

    If an episode ends with `terminated` (for example by a collision), its last period is dropped. If `disturbed`
    returns True, something else than the input moved the robot, and the trajectory ends before that period.

    >>> from brakeline import robot_named
    >>> env = gymnasium.make("brakeline.envs:brakeline/Ground-v0")
    >>> data = collect(env, robot_named("ground"), periods=30, shown=False)
    >>> sum(len(trajectory.inputs) for trajectory in data.trajectories)
    30

    Args:
        seed: draws the inputs and the episodes.
        held: largest number of periods for which an input is held: enough to reach the top speed.
        state: (env, observation, info) -> measured state (n,). Defaults to `info["state"]`.
        actions: mapping between actions and inputs, as in `SafetyWrapper`.
        chord_deviation: largest distance in m of the path from the straight lines between the positions in
            `info["subsamples"]`, or without them from the one over the period. Defaults to twice the value that
            follows from the recorded accelerations.
        options: options of every `reset`.
        shown: whether to show progress on the terminal.

    Raises:
        Mismatch: the environment gives no state, or its action space does not match the robot's inputs.
        BadData: the recording is not a valid data set, or every episode ends at once, or `acceleration_age` in `info`
            differs between episodes.
    """
    if chord_deviation is not None and not 0.0 <= chord_deviation < math.inf:
        raise BadData(f"the chord deviation {chord_deviation} is no length in m")
    driven = _Environment(env, robot, mapping_for_space(env.action_space, robot, actions), state, disturbed)
    with under_way(f"driving {robot.name}", periods) if shown else nullcontext(_ignore) as advance:
        trajectories = _drive(driven, robot, periods, held, seed, options, advance)
    if chord_deviation is None:
        chord_deviation = _chord_deviation(robot, trajectories)
    about = {"origin": str(getattr(env.spec, "id", None) or type(env.unwrapped).__name__), "seed": str(seed)}
    about |= about_age(driven.ages)
    data = Dataset(robot, without_repeats(robot, trajectories)[0], about, chord_deviation)
    data.check()
    return data


def _drive(
    driven: _Environment,
    robot: Robot,
    periods: int,
    held: int,
    seed: int,
    options: dict[str, Any] | None,
    advance: Advance,
) -> list[Trajectory]:
    """Drive episodes until they have so many periods. Raises BadData: every episode ends at once."""
    trajectories: list[Trajectory] = []
    empty_episodes = number = recorded = 0
    while recorded < periods:
        inputs, left = excitation(robot, np.random.default_rng((seed, number)), held), periods - recorded
        episode = driven.episode(inputs, min(LONGEST, left), None if number else seed, options)
        new = [t for t in episode if len(t.inputs) >= min(FEWEST, left)]
        number += 1
        empty_episodes = 0 if new else empty_episodes + 1
        if empty_episodes >= MAX_EMPTY:
            raise BadData(f"{MAX_EMPTY} episodes in a row ended before period {FEWEST}: check why the environment ends")
        trajectories += new
        added = sum(len(t.inputs) for t in new)
        recorded += added
        advance(added)
    return trajectories


def _chord_deviation(robot: Robot, trajectories: list[Trajectory]) -> float:
    """Return twice a·(T/S)²/8 [m] for S positions in each period T, the largest of all trajectories.

    A path with acceleration a leaves its chord by a·t²/8 within a time t. The second differences of the positions are
    a·T².
    """
    longest = ((bends(robot, t.states).max(), t.paths.shape[1]) for t in trajectories if len(t.inputs) > 1)
    return max((float(bend) / (4.0 * samples**2) for bend, samples in longest), default=0.0)


def _ignore(by: int = 1, what: str | None = None) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class _Environment:
    """An environment that a robot's inputs drive."""

    env: gymnasium.Env[Any, Any]
    robot: Robot
    mapping: ActionMapping
    view: View
    disturbed: Callable[[Any, Any, dict[str, Any]], bool]
    ages: set[float] = field(default_factory=set)  # `acceleration_age` in `info` of the episodes [s]

    def episode(
        self, inputs: Generator[Array, Array | None, None], most: int, seed: int | None, options: dict[str, Any] | None
    ) -> Iterator[Trajectory]:
        """Yield the undisturbed trajectories of one episode of at most `most` periods."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.ages.add(float(info.get(ENTRY, 0.0)))
        u, built = next(inputs), TrajectoryBuilder(self._state(observation, info))
        for _ in range(most):
            action = action_for(u, self.mapping, self.env.action_space)
            observation, _, terminated, truncated, info = self.env.step(action)
            if terminated:
                break
            state, in_force = self._state(observation, info), np.asarray(info.get("input_in_force", u), dtype=float)
            executed = np.clip(in_force, self.robot.low(), self.robot.high())
            if self.disturbed(self.env, observation, info):
                yield from [built.trajectory()] if len(built) else []
                built = TrajectoryBuilder(state, executed)
            else:
                seen = displacement(self.robot, built.state, state)
                turned = 0.0 if self.robot.heading is None else float(seen[self.robot.heading])
                moved = seen[: self.robot.position_dim] if self.robot.position_dim else state - built.state
                path = np.array(info.get("subsamples", moved[None]), dtype=float)  # a copy
                built.add(executed, state, path, float(info.get("turned", turned)))
            if truncated:
                break
            u = inputs.send(state)
        yield from [built.trajectory()] if len(built) else []

    def _state(self, observation: Any, info: dict[str, Any]) -> Array:
        return np.array(self.view(self.env, observation, info), dtype=float)
