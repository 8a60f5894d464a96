"""The Gymnasium wrappers refuse another robot, penalties that are no numbers to subtract, and rows of other sizes."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from brakeline.errors import BadRequest, Mismatch
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.task import with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.gym_vector import VectorSafetyWrapper
from brakeline.safety.service.fleet_client import FleetClient
from brakeline.safety.service.in_process import InProcess
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.navigation_env import NavigationEnv
from tests.robots import GROUND, QUADROTOR

SAFETY = Filter.load("ground")
WIDE = with_task(
    robot_from_description(GROUND.description | {"name": "wide", "body": [{"at": [0.0, 0.0], "radius": 0.15}]}),
    GROUND.task,
)
Wrap = Callable[..., Any]  # (filter, how) -> the wrapped environments of the ground robot


def one(filter: Any = SAFETY, robot: Any = GROUND, **how: Any) -> SafetyWrapper:
    return SafetyWrapper(NavigationEnv(robot), filter, **how)


def vector(filter: Any = SAFETY, robot: Any = GROUND, **how: Any) -> VectorSafetyWrapper:
    return VectorSafetyWrapper(gymnasium.vector.SyncVectorEnv([lambda: NavigationEnv(robot)] * 2), filter, **how)


def batch(filter: Any = SAFETY, robot: Any = GROUND, **how: Any) -> BatchSafetyWrapper:
    return BatchSafetyWrapper(BatchNavigationEnv(robot, 2), filter, **how)


@pytest.mark.parametrize("wrap", [one, vector])
def test_a_filter_of_another_body_is_refused(wrap: Wrap) -> None:
    """Same coordinates, same inputs: without this check, the filter would keep a narrower body clear."""
    with pytest.raises(Mismatch, match=r"robot wide, the filter was made for ground.* differ in body, name\. Give"):
        wrap(robot=WIDE)


def test_an_environment_that_resets_itself_is_refused() -> None:
    """A reset that the wrapper does not see looks like a jump of the robot: the sets would widen a thousandfold."""
    with pytest.raises(Mismatch, match=r"Autoreset inside .* put Autoreset around the SafetyWrapper"):
        SafetyWrapper(
            gymnasium.wrappers.TransformReward(gymnasium.wrappers.Autoreset(NavigationEnv(GROUND)), abs), SAFETY
        )
    env = gymnasium.wrappers.Autoreset(one())
    env.reset(seed=0)
    assert env.step(np.zeros(2))[4]["safety"].verified


def test_the_state_of_one_environment_is_refused_for_a_vector() -> None:
    env = vector(state=lambda _, observations, infos: observations[0])
    env.reset(seed=0)
    with pytest.raises(
        Mismatch, match=r"state has 26 rows: give one for each of the 2 environments. If a function reads"
    ):
        env.step(env.action_space.sample())


def test_a_filter_of_another_robot_is_refused_for_a_batch() -> None:
    with pytest.raises(Mismatch, match="robot quadrotor, the filter was made for ground"):
        batch(robot=QUADROTOR)


def test_a_filter_of_a_robot_in_real_time_is_refused() -> None:
    env = NavigationEnv(with_task(GROUND.in_real_time(), GROUND.task))
    with pytest.raises(Mismatch, match="differ in real time"):
        SafetyWrapper(env, SAFETY)


@pytest.mark.parametrize("wrap", [one, vector, batch])
@pytest.mark.parametrize("penalty", [float("nan"), float("inf"), -1.0])
def test_a_penalty_that_no_reward_has_is_refused(wrap: Wrap, penalty: float) -> None:
    with pytest.raises(ValueError, match="penalty = "):
        wrap(penalty=penalty)


@pytest.mark.parametrize("wrap", [vector, batch, InProcess])
@pytest.mark.parametrize("filter", [InProcess(SAFETY), object.__new__(FleetClient), SAFETY.model, "ground"])
def test_only_a_filter_decides_in_process(wrap: Wrap, filter: Any) -> None:
    """A wrapper took a fleet's client, and failed in the first step."""
    said = rf"a filter is needed here, not a {type(filter).__name__}: give Filter\.load\(NAME_OR_PATH\)"
    with pytest.raises(TypeError, match=said):
        wrap(filter)


@pytest.mark.parametrize("wrap", [vector, batch])
@pytest.mark.parametrize("shape", [(1, 2), (3, 2), (4,), (2, 3), ()])
def test_each_environment_gets_one_action(wrap: Wrap, shape: tuple[int, ...]) -> None:
    """One row would count for all robots of a batch, and a row too many for none."""
    env = wrap()
    env.reset(seed=0)
    with pytest.raises(BadRequest, match=r"give \(2, 2\), for each of the 2 environments speed \[m/s\], turn rate"):
        env.step(np.zeros(shape))
    env.step(np.zeros((2, 2)))
    env.close()
