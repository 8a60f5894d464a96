"""A model set decides only about states whose horizontal acceleration has the age of its recorded data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from brakeline.deploy.data.environment_episodes import collect
from brakeline.deploy.run.recorded_client import RecordedClient
from brakeline.errors import BadData, BadModel, BadRequest, Mismatch, SafetyError
from brakeline.logs.reader import open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import ENTRY, about_age, acceleration_age_in
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.batch.row_by_row import RowByRow
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ALLOWED
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.gym_batch import BatchSafetyWrapper
from brakeline.safety.gym_vector import VectorSafetyWrapper
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.client import SafetyClient, request_message
from brakeline.safety.service.fleet_client import FleetClient
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import request_of
from brakeline.sim.batch.batch_env import BatchNavigationEnv
from brakeline.sim.navigation_env import NavigationEnv
from tests.messaging.conftest import endpoint, join  # noqa: F401 - fixtures
from tests.robots import GROUND
from tests.safety.asked import request
from tests.safety.served import Service

STILL = [0.0] * 5


@pytest.fixture(scope="module")
def aged(model: ModelSet) -> Filter:
    return Filter(replace(model, about=model.about | about_age([0.2, 0.2])))


def test_another_age_is_refused_by_every_way_to_ask(aged: Filter, ready: Filter) -> None:
    refused = pytest.raises(BadRequest, match=r"recorded with the horizontal acceleration of 0\.2 s ago.* of 0 s ago")
    present = request(action=(0.1, 0.0), known_free=True)
    with refused:
        aged.decide(present)
    with refused:
        aged.decide_all([present] * 2000)
    with refused:
        aged.decide_batch(RequestArrays.of([present] * 2))
    with refused:
        InProcess(aged, accept_bound=1.0).decide(STILL, (0.1, 0.0), known_free=True)
    with pytest.raises(BadRequest, match=r"of 0 s ago; this state has that of 0\.2 s ago"):
        ready.decide_all([replace(present, acceleration_age=0.2)] * 2000)


def test_the_right_age_is_answered_also_after_the_wire(aged: Filter) -> None:
    session = InProcess(aged, accept_bound=1.0, acceleration_age=0.2)
    assert session.decide(STILL, (0.1, 0.0), known_free=True).kind == ALLOWED
    message = request_message(BackupPlan(GROUND, acceleration_age=0.2), STILL, (0.1, 0.0), known_free=True)
    received = request_of(pb.Request.FromString(message.SerializeToString()), GROUND)
    assert aged.decide(received).kind == ALLOWED
    assert {answer.kind for answer in aged.decide_all([received] * 2000)} == {ALLOWED}


def test_the_right_age_is_answered_in_a_batch(aged: Filter) -> None:
    requests = replace(RequestArrays.of([request(action=(0.1, 0.0), known_free=True)] * 2), acceleration_age=0.2)
    for method in (aged, RowByRow(aged)):
        assert method.decide_batch(requests).kind.tolist() == [0, 0]
    assert aged.decide_batch(requests.rows([1])).kind.tolist() == [0]


class Stating(NavigationEnv):
    """An environment that says that its states hold the acceleration of 0.2 s ago."""

    def _info(self, period: Any) -> Any:
        return super()._info(period) | {"acceleration_age": 0.2}


class Silent(NavigationEnv):
    """An environment that says nothing about its accelerations."""

    def _info(self, period: Any) -> Any:
        return {name: value for name, value in super()._info(period).items() if name != "acceleration_age"}


def one(filter: Any, env: type[NavigationEnv] = NavigationEnv, **how: Any) -> Any:
    return SafetyWrapper(env("ground"), filter, accept_bound=1.0, **how)


def vector(filter: Any, env: type[NavigationEnv] = NavigationEnv, **how: Any) -> Any:
    envs = gymnasium.vector.SyncVectorEnv([lambda: env("ground")] * 2)
    return VectorSafetyWrapper(envs, filter, accept_bound=1.0, **how)


def batch(filter: Any, _: Any = None, **how: Any) -> Any:
    return BatchSafetyWrapper(BatchNavigationEnv("ground", 2), filter, accept_bound=1.0, **how)


@pytest.mark.parametrize("wrap", [one, vector, batch])
def test_a_wrapper_says_before_the_first_step_that_the_ages_differ(aged: Filter, ready: Filter, wrap: Any) -> None:
    """A batch would brake for ever."""
    for env, filter, how in ((NavigationEnv, aged, {}), (Silent, aged, {}), (Silent, ready, {"acceleration_age": 0.2})):
        with pytest.raises(Mismatch, match=r"recorded with the horizontal acceleration of 0.* give acceleration_age=0"):
            wrap(filter, env, **how).reset(seed=0)


@pytest.mark.parametrize("wrap", [one, vector, batch])
def test_a_wrapper_asks_with_the_age_that_it_is_given(aged: Filter, wrap: Any) -> None:
    env = wrap(aged, Silent, acceleration_age=0.2)
    env.reset(seed=0)
    *_, infos = env.step(np.zeros(env.action_space.shape))
    decided = infos["outcome"].answers.kind == 0 if wrap is batch else infos["diagnostics"]["kind"] == ALLOWED
    assert np.all(decided)
    env.close()


@pytest.mark.parametrize("wrap", [one, vector])
def test_a_wrapper_asks_with_the_age_that_the_environment_states(aged: Filter, wrap: Any) -> None:
    env = wrap(aged, Stating)
    for _ in range(2):
        env.reset(seed=0)
        assert np.all(env.step(np.zeros(env.action_space.shape))[4]["diagnostics"]["kind"] == ALLOWED)
    one(InProcess(aged, 1.0, acceleration_age=0.2), Silent).reset(seed=0)


def test_data_of_an_environment_say_the_age_that_it_states() -> None:
    data = collect(Stating("ground"), GROUND, periods=30, shown=False)
    assert acceleration_age_in(data.about) == 0.2


def test_a_log_of_an_own_program_says_the_age(aged: Filter, tmp_path: Path) -> None:
    with RecordedClient(InProcess(aged, accept_bound=1.0, acceleration_age=0.2), tmp_path / "mine") as client:
        for _ in range(3):
            client.decide(STILL, (0.0, 0.0), known_free=True)
    steps = [record.message for record in open_log(client.path) if record.topic == "step"]
    assert {step.acceleration_age for step in steps} == {0.2}


def test_environments_of_different_ages_are_refused(aged: Filter) -> None:
    envs = gymnasium.vector.SyncVectorEnv([lambda: NavigationEnv("ground"), lambda: Stating("ground")])
    with pytest.raises(Mismatch, match=r"different ages \(0 s, 0\.2 s\)"):
        VectorSafetyWrapper(envs, aged, accept_bound=1.0).reset(seed=0)


def test_clients_of_a_service_state_the_age(aged: Filter, join: Any, endpoint: str) -> None:  # noqa: F811
    join("safety", listen=True).serve(DECIDE, Service(aged.model).answer)
    with SafetyClient.open(endpoint, "ground", 5.0, acceleration_age=0.2) as client:
        assert client.decide(STILL, (0.1, 0.0), known_free=True).kind == ALLOWED
    with FleetClient.open(endpoint, "ground", ["a", "b"], 5.0, acceleration_age=0.2) as fleet:
        states = [STILL, [1.0, *STILL[1:]]]
        assert [answer.kind for answer in fleet.decide(states, [(0.1, 0.0)] * 2, known_free=True)] == [ALLOWED] * 2
    with SafetyClient.open(endpoint, "ground", 5.0, name="other") as client:
        env = one(client)
        env.reset(seed=0)
        with pytest.raises(SafetyError, match=r"recorded with the horizontal acceleration of 0\.2 s ago"):
            env.step(np.zeros(2))


@pytest.mark.parametrize("age", ["nan", "-0.2", "1.5", "soon"])
def test_a_model_set_with_an_impossible_age_is_refused(model: ModelSet, age: str) -> None:
    with pytest.raises(BadModel, match="age of the acceleration"):
        Filter(replace(model, about=model.about | {ENTRY: age}))


def test_data_of_different_ages_are_not_mixed() -> None:
    assert about_age([0.0, 0.0]) == {} and acceleration_age_in(about_age([0.2])) == 0.2
    with pytest.raises(BadData, match=r"different ages \(0 s, 0\.2 s\)"):
        about_age([0.2, 0.0])
