"""Record a data set in a Gymnasium environment, with excitation as the policy.

data = collect(env, robot, periods=30_000, state=state, actions=normalised(robot))
model, statement = certify(data, ModelConfig())
env = SafetyWrapper(env, Filter(model), state=state, obstacles=obstacles, actions=normalised(robot))
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from brakeline.deploy.data.excitation import MOST_HELD, excitation
from brakeline.errors import BadData
from brakeline.messaging.robot import Robot
from brakeline.safety.action_mapping import ActionMapping, cast_action, mapping_for_space
from brakeline.safety.environment_views import STATE, View
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.windows import displacement

Array = NDArray[np.float64]

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

    Args:
        held: largest number of periods for which an input is held: enough to reach the top speed.
        state: (env, observation, info) -> measured state (n,). Defaults to `info["state"]`.
        actions: mapping between actions and inputs, as in `SafetyWrapper`.
        chord_deviation: largest distance in m of the path from its chord within a period, if `info` has no `subsamples`
            and `turned`. Defaults to twice the value that follows from the recorded accelerations.
        options: options of every `reset`.
        shown: whether to show progress on the terminal.

    Raises:
        Mismatch: the environment gives no state, or its action space does not match the robot's inputs.
        BadData: the recording is not a valid data set, or every episode ends at once.
    """
    between = mapping_for_space(env.action_space, robot, actions)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    trajectories: list[Trajectory] = []
    empty_episodes = number = 0
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as progress:
        task = progress.add_task(f"driving {robot.name}", total=periods)
        while not progress.finished:
            rng = np.random.default_rng((seed, number))
            first = seed if number == 0 else None
            left = periods - int(progress.tasks[0].completed)
            new = [
                t
                for t in _episode(
                    env,
                    robot,
                    excitation(robot, rng, held),
                    first,
                    min(LONGEST, left),
                    options,
                    between,
                    state,
                    disturbed,
                )
                if len(t.inputs) >= min(FEWEST, left)
            ]
            number += 1
            empty_episodes = 0 if new else empty_episodes + 1
            if empty_episodes >= MAX_EMPTY:
                raise BadData(
                    f"{MAX_EMPTY} episodes in a row ended before period {FEWEST}: check why the environment ends"
                )
            trajectories += new
            progress.advance(task, sum(len(t.inputs) for t in new))
    sampled = any(t.paths.shape[1] > 1 for t in trajectories)
    off = (
        chord_deviation
        if chord_deviation is not None
        else 0.0
        if sampled
        else _chord_deviation_bound(robot, trajectories)
    )
    about = {"origin": str(getattr(env.spec, "id", None) or type(env.unwrapped).__name__), "seed": str(seed)}
    data = Dataset(robot, tuple(trajectories), about, off)
    data.check()
    return data


def _episode(
    env: gymnasium.Env[Any, Any],
    robot: Robot,
    inputs: Generator[Array, Array | None, None],
    seed: int | None,
    most: int,
    options: dict[str, Any] | None,
    between: ActionMapping,
    state: View,
    disturbed: Callable[[Any, Any, dict[str, Any]], bool],
) -> Iterator[Trajectory]:
    """Yield the undisturbed trajectories of one episode."""
    observation, info = env.reset(seed=seed, options=options)
    measured = np.array(state(env, observation, info), dtype=float)
    u, before = next(inputs), None
    record = _RecordedEpisode(robot, measured, before)
    for _ in range(most):
        action = cast_action(between.control_to_action(u), env.action_space)
        observation, _, terminated, truncated, info = env.step(action)
        if terminated:
            break
        measured = np.array(state(env, observation, info), dtype=float)
        executed = np.clip(np.asarray(info.get("input_in_force", u), dtype=float), robot.low(), robot.high())
        if disturbed(env, observation, info):
            yield from record.done()
            record = _RecordedEpisode(robot, measured, executed)
        else:
            record.add(executed, measured, info)
        if truncated:
            break
        u = inputs.send(measured)
    yield from record.done()


class _RecordedEpisode:
    """A trajectory during its recording."""

    def __init__(self, robot: Robot, state: Array, before: Array | None) -> None:
        self.robot, self.before = robot, before
        self.states, self.inputs = [state], list[Array]()
        self.paths, self.turned = list[Array](), list[float]()

    def add(self, executed: Array, state: Array, info: dict[str, Any]) -> None:
        seen = displacement(self.robot, self.states[-1], state)
        turned = 0.0 if self.robot.heading is None else float(seen[self.robot.heading])
        self.paths.append(np.asarray(info.get("subsamples", seen[None, : self.robot.position_dim]), dtype=float))
        self.turned.append(float(info.get("turned", turned)))
        self.states.append(state)
        self.inputs.append(executed)

    def done(self) -> Iterator[Trajectory]:
        if self.inputs:
            states, inputs, paths = np.array(self.states), np.array(self.inputs), np.array(self.paths)
            yield Trajectory(states, inputs, paths, np.array(self.turned), self.before)


def _chord_deviation_bound(robot: Robot, trajectories: list[Trajectory]) -> float:
    """Return twice a·T²/8 in m: a path with acceleration a leaves its chord by a·T²/8 within a period T.

    The second differences of the positions are a·T².
    """
    bends = [np.diff(t.states[:, : robot.position_dim], n=2, axis=0) for t in trajectories if len(t.inputs) > 1]
    return max((float(np.linalg.norm(bend, axis=1).max()) for bend in bends), default=0.0) / 4.0
