"""An actor's link to a scripted learner."""

import threading
import time
from collections.abc import Callable

import pytest

from brakeline.actors.learner_client import LearnerClient
from brakeline.errors import RefusedByLearner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from tests.actors.scripted_learner import ScriptedLearner
from tests.robots import GROUND
from tests.waiting import until


def never() -> bool:
    return False


def joined(buses: tuple[Bus, Bus], lockstep: bool = False) -> tuple[ScriptedLearner, LearnerClient]:
    learner, client = ScriptedLearner(buses[0]), LearnerClient(buses[1], GROUND, "actor-0", lockstep)
    assert client.join(0, 0, never) == 3
    return learner, client


def waiting(client: LearnerClient, index: int, stop: Callable[[], bool] = never) -> list[bool]:
    """Call `wait` in a thread; the list gets its result."""
    results: list[bool] = []
    threading.Thread(target=lambda: results.append(client.wait(index, 7, stop)), daemon=True).start()
    return results


def test_join_waits_for_a_learner_and_returns_the_episode(buses: tuple[Bus, Bus]) -> None:
    client = LearnerClient(buses[1], GROUND, "actor-0")
    answers: list[int | None] = []
    thread = threading.Thread(target=lambda: answers.append(client.join(12, 4, never)))
    thread.start()
    time.sleep(0.5)
    assert not answers and client.policy is None
    learner = ScriptedLearner(buses[0])
    thread.join(20.0)
    assert answers == [7] and client.policy is not None and client.policy.version == 1
    join = learner.joins[0]
    assert (join.actor, join.index, join.episode, join.layout) == ("actor-0", 12, 4, GROUND.learning_layout())


def test_a_stop_ends_the_wait_for_a_learner(buses: tuple[Bus, Bus]) -> None:
    client = LearnerClient(buses[1], GROUND, "actor-0")
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    assert client.join(0, 0, stop.is_set) is None


def test_the_learner_refuses_another_layout(buses: tuple[Bus, Bus]) -> None:
    ScriptedLearner(buses[0]).layout = "that of another version"
    with pytest.raises(RefusedByLearner, match="layout: another"):
        LearnerClient(buses[1], GROUND, "actor-0").join(0, 0, never)


def test_wait_returns_when_the_learner_permits_the_step(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    result = waiting(client, 5)
    learner.publish_flow(4)
    time.sleep(0.3)
    assert not result
    learner.publish_flow(5)
    until(lambda: result == [True])
    assert client.wait(3, 7, never), "a permission stays valid"


def test_the_end_of_the_run_and_a_stop_end_the_wait(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    stop = threading.Event()
    result = waiting(client, 5, stop.is_set)
    stop.set()
    until(lambda: result == [False])
    result = waiting(client, 5)
    learner.publish_flow(0, done=True)
    until(lambda: result == [False])
    assert client.done


def test_a_restarted_learner_is_joined_even_if_its_weights_are_older(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    learner.publish_weights(9)
    until(lambda: client.policy is not None and client.policy.version == 9)
    learner.version = 4  # restarted from a checkpoint
    learner.publish_flow(20, incarnation=2)
    assert client.wait(11, 7, never)
    assert client.policy is not None and client.policy.version == 4
    assert (len(learner.joins), learner.joins[-1].index, learner.joins[-1].episode) == (2, 10, 7)


def test_an_actor_without_permission_joins_again(buses: tuple[Bus, Bus], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.actors.learner_client.REJOIN_AFTER", 0.2)
    learner, client = joined(buses)
    result = waiting(client, 5)
    until(lambda: len(learner.joins) >= 4)
    assert not result
    learner.publish_flow(5)
    until(lambda: result == [True])


def test_lockstep_waits_for_the_exact_version(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses, lockstep=True)
    learner.publish_flow(1, weights_version=2)
    result = waiting(client, 1)
    time.sleep(0.3)
    assert not result
    learner.publish_weights(2)
    until(lambda: result == [True])
    learner.publish_flow(2, weights_version=3)
    learner.publish_weights(4)
    result = waiting(client, 2)
    time.sleep(0.3)
    assert not result, "newer weights are not the right version"


def test_damaged_or_older_weights_are_ignored(buses: tuple[Bus, Bus], caplog: pytest.LogCaptureFixture) -> None:
    learner, client = joined(buses)
    learner._weights.put(pb.Weights(robot="ground", version=5, file=b"nonsense"))
    learner.publish_weights(6)
    until(lambda: client.policy is not None and client.policy.version == 6)
    learner.publish_weights(2)
    time.sleep(0.2)
    assert client.policy is not None and client.policy.version == 6
    assert "weights 5 are not valid" in caplog.text


def test_implausible_weights_are_ignored_and_the_learner_is_joined_again(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    learner.publish_weights(2**32 - 1)
    until(lambda: buses[1].rejected.count == 1)
    assert client.policy is not None and client.policy.version == 1
    learner.version = 7
    result = waiting(client, 5)
    until(lambda: len(learner.joins) == 2)
    learner.publish_flow(5)
    until(lambda: result == [True])
    assert client.policy.version == 7
    learner.publish_weights(8)
    until(lambda: client.policy is not None and client.policy.version == 8)


def test_an_implausible_permission_is_ignored(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    learner.publish_flow(10**9)
    until(lambda: buses[1].rejected.count == 1)
    result = waiting(client, 5)
    time.sleep(0.3)
    assert not result
    learner.publish_flow(5)
    until(lambda: result == [True])


def test_weights_before_the_first_join_are_ignored(buses: tuple[Bus, Bus]) -> None:
    learner, client = ScriptedLearner(buses[0]), LearnerClient(buses[1], GROUND, "actor-0")
    for version in range(1, 11):
        learner.publish_weights(version)
        time.sleep(0.02)
    assert client.policy is None and buses[1].rejected.count == 0
