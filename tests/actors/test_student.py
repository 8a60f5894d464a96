"""An actor's link to a learner that the tests play."""

import threading
import time
from collections.abc import Callable

import pytest

from brakeline.actors.learner_client import LearnerClient, RefusedByLearner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from tests.actors.teacher import Teacher
from tests.robots import GROUND
from tests.waiting import until


def never() -> bool:
    return False


def joined(buses: tuple[Bus, Bus], lockstep: bool = False) -> tuple[Teacher, LearnerClient]:
    teacher, student = Teacher(buses[0]), LearnerClient(buses[1], GROUND, "actor-0", lockstep)
    assert student.join(0, 0, never) == 3
    return teacher, student


def waiting(student: LearnerClient, index: int, stop: Callable[[], bool] = never) -> list[bool]:
    """The result of `wait`, once there is one."""
    results: list[bool] = []
    threading.Thread(target=lambda: results.append(student.wait(index, 7, stop)), daemon=True).start()
    return results


def test_it_waits_for_a_learner_joins_it_and_is_told_where_to_go_on(buses: tuple[Bus, Bus]) -> None:
    student = LearnerClient(buses[1], GROUND, "actor-0")
    answers: list[int | None] = []
    thread = threading.Thread(target=lambda: answers.append(student.join(12, 4, never)))
    thread.start()
    time.sleep(0.5)
    assert not answers and student.policy is None
    teacher = Teacher(buses[0])
    thread.join(20.0)
    assert answers == [7] and student.policy is not None and student.policy.version == 1
    join = teacher.joins[0]
    assert (join.actor, join.index, join.episode, join.layout) == ("actor-0", 12, 4, GROUND.learning_layout())


def test_a_stop_ends_the_wait_for_a_learner(buses: tuple[Bus, Bus]) -> None:
    student = LearnerClient(buses[1], GROUND, "actor-0")
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    assert student.join(0, 0, stop.is_set) is None


def test_another_layout_is_refused(buses: tuple[Bus, Bus]) -> None:
    Teacher(buses[0]).layout = "that of another version"
    with pytest.raises(RefusedByLearner, match="layout: another"):
        LearnerClient(buses[1], GROUND, "actor-0").join(0, 0, never)


def test_it_goes_as_far_as_it_may(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses)
    result = waiting(student, 5)
    teacher.say(4)
    time.sleep(0.3)
    assert not result
    teacher.say(5)
    until(lambda: result == [True])
    assert student.wait(3, 7, never), "what was allowed stays so"


def test_the_end_of_the_run_and_a_stop_end_the_wait(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses)
    stop = threading.Event()
    result = waiting(student, 5, stop.is_set)
    stop.set()
    until(lambda: result == [False])
    result = waiting(student, 5)
    teacher.say(0, done=True)
    until(lambda: result == [False])
    assert student.done


def test_a_new_incarnation_is_joined_and_its_weights_taken_older_or_not(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses)
    teacher.publish(9)
    until(lambda: student.policy is not None and student.policy.version == 9)
    teacher.version = 4  # restarted from a checkpoint
    teacher.say(20, incarnation=2)
    assert student.wait(11, 7, never)
    assert student.policy is not None and student.policy.version == 4
    assert (len(teacher.joins), teacher.joins[-1].index, teacher.joins[-1].episode) == (2, 10, 7)


def test_without_permission_it_joins_again(buses: tuple[Bus, Bus], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brakeline.actors.learner_client.REJOIN_AFTER", 0.2)
    teacher, student = joined(buses)
    result = waiting(student, 5)
    until(lambda: len(teacher.joins) >= 4)
    assert not result
    teacher.say(5)
    until(lambda: result == [True])


def test_lockstep_waits_for_the_very_version(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses, lockstep=True)
    teacher.say(1, weights_version=2)
    result = waiting(student, 1)
    time.sleep(0.3)
    assert not result
    teacher.publish(2)
    until(lambda: result == [True])
    teacher.say(2, weights_version=3)
    teacher.publish(4)
    result = waiting(student, 2)
    time.sleep(0.3)
    assert not result, "newer weights are not the right ones"


def test_damaged_or_older_weights_are_not_taken(buses: tuple[Bus, Bus], caplog: pytest.LogCaptureFixture) -> None:
    teacher, student = joined(buses)
    teacher._weights.put(pb.Weights(robot="ground", version=5, file=b"nonsense"))
    teacher.publish(6)
    until(lambda: student.policy is not None and student.policy.version == 6)
    teacher.publish(2)
    time.sleep(0.2)
    assert student.policy is not None and student.policy.version == 6
    assert "weights 5 were refused" in caplog.text


def test_weights_that_do_not_go_on_from_ours_are_not_taken_and_the_learner_is_asked(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses)
    teacher.publish(2**32 - 1)
    until(lambda: buses[1].rejected.count == 1)
    assert student.policy is not None and student.policy.version == 1
    teacher.version = 7
    result = waiting(student, 5)
    until(lambda: len(teacher.joins) == 2)
    teacher.say(5)
    until(lambda: result == [True])
    assert student.policy.version == 7
    teacher.publish(8)
    until(lambda: student.policy is not None and student.policy.version == 8)


def test_a_permission_that_no_learner_gives_is_passed_over(buses: tuple[Bus, Bus]) -> None:
    teacher, student = joined(buses)
    teacher.say(10**9)
    until(lambda: buses[1].rejected.count == 1)
    result = waiting(student, 5)
    time.sleep(0.3)
    assert not result
    teacher.say(5)
    until(lambda: result == [True])


def test_nothing_is_taken_before_a_learner_has_taken_it_in(buses: tuple[Bus, Bus]) -> None:
    teacher, student = Teacher(buses[0]), LearnerClient(buses[1], GROUND, "actor-0")
    for version in range(1, 11):
        teacher.publish(version)
        time.sleep(0.02)
    assert student.policy is None and buses[1].rejected.count == 0
