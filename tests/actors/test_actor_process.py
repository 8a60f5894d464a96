"""An actor's process and its link to a learner on a real bus, with a scripted learner and the real core of the safety
service.
"""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from brakeline.actors import actor_process
from brakeline.actors.actor_process import STANDSTILL, STOP_PRACTICE, ActorRunner, ActorSettings, StopPractice, run
from brakeline.actors.actor_settings import PhysicsChange
from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.actors.learner_client import LearnerClient
from brakeline.actors.proposers import RealTimePolicy
from brakeline.deploy.vehicle_factory import environment, fleet_world
from brakeline.errors import BadRequest, BusError, RefusedByLearner
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.robot import robot_named
from brakeline.messaging.topics import DECIDE, EXCHANGE, FLOW, JOIN, STEP, WEIGHTS
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.model.windows import resting_periods_at_end
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from tests.robots import GROUND
from tests.waiting import until


class ScriptedLearner:
    """The bus side of a learner: it accepts every actor of the right layout, and publishes permissions and weights."""

    def __init__(self, bus: Bus) -> None:
        self.flow = pb.Flow(robot="ground", incarnation=1)
        self.version, self.layout = 1, GROUND.learning_layout()
        self.joins: list[pb.Join] = []
        self._flow, self._weights = bus.publisher(FLOW, robot="ground"), bus.publisher(WEIGHTS, robot="ground")
        bus.serve(JOIN, self._join, robot="ground")

    def _join(self, payload: bytes, asker: str) -> bytes:
        join = pb.Join.FromString(payload)
        self.joins.append(join)
        if join.layout != self.layout:
            error = pb.Error(type="Refused", field="layout", message="another layout")
            return pb.JoinReply(error=error).SerializeToString()
        return pb.JoinReply(weights=self.weights(), flow=self.flow, episode=join.episode + 3).SerializeToString()

    def weights(self) -> pb.Weights:
        file = MLP(GROUND, MLP.untrained(GROUND, 0, (8,)).layers, self.version).encode()
        return pb.Weights(robot="ground", version=self.version, file=file)

    def publish_flow(self, limit: int, **fields: object) -> None:
        self.flow.limit["actor-0"] = limit
        for name, value in fields.items():
            setattr(self.flow, name, value)
        self._flow.put(self.flow)

    def publish_weights(self, version: int) -> None:
        self.version = version
        self._weights.put(self.weights())


def never() -> bool:
    return False


def version(client: LearnerClient) -> int | None:
    """Return the version of an actor's weights."""
    return None if client.policy is None else client.policy.version


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
    client, stop = LearnerClient(buses[1], GROUND, "actor-0"), threading.Event()
    threading.Timer(0.3, stop.set).start()
    assert client.join(0, 0, stop.is_set) is None
    answers: list[int | None] = []
    thread = threading.Thread(target=lambda: answers.append(client.join(12, 4, never)))
    thread.start()
    time.sleep(0.5)
    assert not answers and version(client) is None
    learner = ScriptedLearner(buses[0])
    thread.join(20.0)
    assert answers == [7] and version(client) == 1
    join = learner.joins[0]
    assert (join.actor, join.index, join.episode, join.layout) == ("actor-0", 12, 4, GROUND.learning_layout())


def test_the_learner_refuses_another_layout(buses: tuple[Bus, Bus]) -> None:
    ScriptedLearner(buses[0]).layout = "that of another version"
    with pytest.raises(RefusedByLearner, match="layout: another"):
        LearnerClient(buses[1], GROUND, "actor-0").join(0, 0, never)


def test_an_actor_asks_again_after_a_damaged_reply_to_its_join(caplog: pytest.LogCaptureFixture) -> None:
    weights = ScriptedLearner.weights(cast(Any, SimpleNamespace(version=1)))
    good = pb.JoinReply(weights=weights, flow=pb.Flow(robot="ground", incarnation=1), episode=3)
    replies = [b"\xff\xff", good.SerializeToString()[:-3], b"", good.SerializeToString()]
    bus: Any = SimpleNamespace(subscribe=lambda *_, **__: None, ask=lambda *_, **__: replies.pop(0))
    client = LearnerClient(bus, GROUND, "actor-0")
    with caplog.at_level(logging.INFO):
        assert client.join(0, 0, never) == 3
    assert not replies and version(client) == 1
    assert "waits for a learner: its reply cannot be read" in caplog.text


def test_the_physics_change_after_the_steps_of_the_whole_run_also_when_the_actor_was_restarted() -> None:
    weights = ScriptedLearner.weights(cast(Any, SimpleNamespace(version=1)))
    replies = [
        pb.JoinReply(weights=weights, flow=pb.Flow(incarnation=run), steps=steps) for run, steps in ((1, 70), (2, 90))
    ]
    bus: Any = SimpleNamespace(subscribe=lambda *_, **__: None, ask=lambda *_, **__: replies.pop(0).SerializeToString())
    client, changes = LearnerClient(bus, GROUND, "actor-0"), list[tuple[int, float]]()
    client.join(0, 0, never)
    proposer = SimpleNamespace(earlier_steps=client.earlier_steps, ready=lambda *_: True)
    runner = SimpleNamespace(index=0)
    runner.env = SimpleNamespace(alter=lambda payload_kg: changes.append((runner.index, payload_kg)))
    actor = SimpleNamespace(
        runner=runner, proposer=proposer, change=PhysicsChange(100, 2.0), _changed=False, next_episode=3
    )
    for runner.index in range(50):
        ActorRunner.may_step(cast(Any, actor), never)
    assert changes == [(30, 2.0)], "70 steps came before the restart"
    client.join(50, 5, never)
    assert client.earlier_steps == 70, "the actor goes on: only the learner was restarted"


def test_wait_returns_when_the_learner_permits_the_step(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    result = waiting(client, 5)
    learner.publish_flow(10**9)  # implausible
    until(lambda: buses[1].rejected.count == 1)
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
    until(lambda: version(client) == 9)
    learner.version = 4  # restarted from a checkpoint
    learner.publish_flow(20, incarnation=2)
    assert client.wait(11, 7, never)
    assert version(client) == 4
    assert (len(learner.joins), learner.joins[-1].index, learner.joins[-1].episode) == (2, 10, 7)


def test_a_robot_in_real_time_goes_on_when_a_restarted_learner_refuses_it(
    buses: tuple[Bus, Bus], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pause = threading.Event()
    monkeypatch.setattr("brakeline.actors.proposers.time", SimpleNamespace(sleep=pause.wait))
    learner, policy = ScriptedLearner(buses[0]), RealTimePolicy(buses[1], GROUND, "actor-0")
    assert policy.join(0, 0, never) == 3
    learner.layout, learner.version = "that of another version", 4
    learner.publish_flow(20, incarnation=2)
    until(lambda: policy.ready(11, 7, never) and "the learner refuses actor-0" in caplog.text)
    assert all(policy.ready(12, 7, never) for _ in range(100)) and len(learner.joins) == 2, "it asks from time to time"
    learner.layout = GROUND.learning_layout()
    pause.set()
    until(lambda: policy.ready(13, 7, never) and version(policy) == 4)


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
    until(lambda: version(client) == 6)
    learner.publish_weights(2)
    time.sleep(0.2)
    assert version(client) == 6
    assert "weights 5 are not valid" in caplog.text


def test_implausible_weights_are_ignored_and_the_learner_is_joined_again(buses: tuple[Bus, Bus]) -> None:
    learner, client = joined(buses)
    learner.publish_weights(2**32 - 1)
    until(lambda: buses[1].rejected.count == 1)
    assert version(client) == 1
    learner.version = 7
    result = waiting(client, 5)
    until(lambda: len(learner.joins) == 2)
    learner.publish_flow(5)
    until(lambda: result == [True])
    assert version(client) == 7
    learner.publish_weights(8)
    until(lambda: version(client) == 8)


def test_weights_before_the_first_join_are_ignored(buses: tuple[Bus, Bus]) -> None:
    learner, client = ScriptedLearner(buses[0]), LearnerClient(buses[1], GROUND, "actor-0")
    for number in range(1, 11):
        learner.publish_weights(number)
        time.sleep(0.02)
    assert version(client) is None and buses[1].rejected.count == 0


STEPS = 60  # that each robot may take


class Service:
    """A safety service in the test's process, which can fail and records its requests."""

    def __init__(self, bus: Bus, data_folder) -> None:
        from brakeline.deploy.data.model_store import model_for

        models = ModelRegistry()
        models.install(model_for(GROUND, ModelConfig()))
        self._answer = BatchHandler(models, ServiceCounts())
        self.batches: list[list[str]] = []
        self.proposals: list[list[float]] = []  # of the first robot
        self.failing = self.fails_when_moving = False
        self.failure: Exception = RuntimeError("out of order")
        bus.serve(DECIDE, self._decide, robot="ground")

    def _decide(self, payload: bytes, asker: str) -> bytes:
        requests = pb.RequestBatch.FromString(payload).requests
        self.batches.append([request.actor for request in requests])
        self.proposals.append(list(requests[0].action))
        self.failing |= self.fails_when_moving and any(requests[0].input_in_force)
        if self.failing:
            raise self.failure
        return self._answer(payload)


@pytest.fixture
def scene(buses, data_folder):
    """Return the service, lists of the published steps and exchanges, and a function that starts the actors."""
    learner, _ = buses
    steps: list[pb.Step] = []
    exchanges: list[pb.Exchange] = []
    learner.subscribe(STEP, lambda sample: steps.append(sample.message()))
    learner.subscribe(EXCHANGE, lambda sample: exchanges.append(sample.message()))
    threads: list[threading.Thread] = []
    scripted = ScriptedLearner(learner)

    def start(robots: int, limit: int = STEPS, **settings) -> None:
        names = ["actor-0"] if robots == 1 else [f"actor-0.{i}" for i in range(robots)]
        scripted.flow.limit.update(dict.fromkeys(names, limit))
        bus = BusSettings(connect=learner.settings.listen)
        values = ActorSettings(bus, robots=robots, deadline=2.0, **settings)
        arguments = (values, partial(environment), None, fleet_world)
        threads.append(threading.Thread(target=run, args=arguments, daemon=True))
        threads[0].start()

    def end() -> None:
        scripted.publish_flow(0, done=True)
        for thread in threads:
            thread.join(20.0)
            assert not thread.is_alive()

    service = Service(learner, data_folder)
    yield service, steps, exchanges, start
    end()


def test_a_practised_stop_follows_its_plan_as_long_as_the_plan_holds():
    """Near an obstacle the filter may prefer another input; following it would leave no complete stop in the log."""
    runner = SimpleNamespace(robot=GROUND, backup_plan=BackupPlan(GROUND), rng=np.random.default_rng(0))
    runner.backup_plan.accept(np.full((GROUND.horizon, 2), 0.2), "a model", None, True)
    answers = {kind: SimpleNamespace(kind=kind) for kind in ("allowed", "adjusted", "failsafe", "recovering")}
    outcomes = {kind: DecisionOutcome(pb.Request(), pb.Reply(), answer, "", 1.0) for kind, answer in answers.items()}
    practice, never = StopPractice(1.0), StopPractice(0.0)
    for one in (practice, never):
        one.proposal(runner, np.zeros(2))
    assert [kind for kind, outcome in outcomes.items() if practice.outcome(runner, outcome).answer] == ["allowed"]
    assert practice.outcome(runner, outcomes["adjusted"]).failure == STOP_PRACTICE
    assert all(never.outcome(runner, outcome) is outcome for outcome in outcomes.values())
    runner.backup_plan.accept(np.full((GROUND.horizon, 2), 0.2), "a model", None, False)
    assert all(practice.outcome(runner, outcome) is outcome for outcome in outcomes.values())


@pytest.mark.parametrize("kind", ["allowed", "adjusted"])
def test_a_practised_stop_ends_although_each_answer_commits_a_new_plan(kind):
    """A quadrotor brakes over seven periods: it followed the newest plan, became slower, and never stood."""
    robot = robot_named("quadrotor")
    runner = SimpleNamespace(robot=robot, backup_plan=BackupPlan(robot), rng=np.random.default_rng(0))

    def decided(proposal):
        plan = robot.stop_profile() * proposal
        return DecisionOutcome(pb.Request(), pb.Reply(), SimpleNamespace(kind=kind, plan=plan), "", 1.0)

    practice = StopPractice(1.0)
    runner.backup_plan.accept(robot.stop_profile() * [2.0, -1.0, 0.0], "a model", None, True)
    executed = []
    for _ in range(robot.horizon + STANDSTILL):
        proposal = practice.proposal(runner, np.full(3, 5.0))
        outcome = practice.outcome(runner, decided(proposal))
        if outcome.answer is None:
            executed.append(runner.backup_plan.fallback())
        else:
            executed.append(runner.backup_plan.accept(outcome.answer.plan, "a model", None, True))
    assert practice.running and not np.array(executed)[-resting_periods_at_end(robot) - STANDSTILL :].any()


def test_one_question_is_about_all_robots_of_a_process(scene):
    service, steps, exchanges, start = scene
    start(robots=3, limit=20)
    until(lambda: len(steps) == 3 * 20 and len(exchanges) == 3 * 20)
    names = ["actor-0.0", "actor-0.1", "actor-0.2"]
    assert service.batches == [names] * 20
    for name in names:
        own = [step for step in steps if step.actor == name]
        assert [step.index for step in own] == list(range(1, 21))
        assert [step.header.sequence for step in own] == list(range(1, 21))
    starts = {tuple(step.true_state) for step in steps if step.index == 1}
    assert len(starts) == 3, "each robot has its own arena"


def test_an_actor_whose_questions_are_refused_for_good_ends_with_the_reason(buses, data_folder, monkeypatch):
    monkeypatch.setattr(actor_process, "RETRY_INTERVAL", 0.0)
    service, scripted = Service(buses[0], data_folder), ScriptedLearner(buses[0])
    service.failing, service.failure = True, BadRequest("obstacles", "1200 obstacles; at most 1000")
    scripted.flow.limit.update({"actor-0": STEPS})
    settings = ActorSettings(BusSettings(connect=buses[0].settings.listen), deadline=2.0)
    with pytest.raises(BusError, match=r"refuses every query about these robots: .*1200 obstacles"):
        run(settings, environment)


def test_a_process_has_no_more_robots_than_a_question():
    with pytest.raises(ValueError, match="1 to 64 robots, not 65: start more actors"):
        ActorSettings(BusSettings(), robots=65)


def test_without_the_service_a_robot_brakes_along_its_plan_waits_and_drives_on(scene):
    service, steps, exchanges, start = scene
    start(robots=1, limit=10**6)

    until(lambda: len(steps) > 20)
    service.fails_when_moving = True
    until(lambda: service.failing)
    quiet = -1
    while quiet != len(steps):  # the robot stands, and its episode does not go on
        quiet, questions = len(steps), len(service.proposals)
        time.sleep(0.5)
    repeated = service.proposals[questions:]
    assert len(repeated) > 3 and repeated == [repeated[0]] * len(repeated), "a waiting robot keeps its proposal"
    lost = [step for step in steps if step.fallback]
    assert lost and lost[-1] is steps[-1] and not any(steps[-1].action)
    first = steps.index(lost[0])
    answers = {(e.request.episode, e.request.step): e.reply.decision for e in exchanges if not e.failure}
    before = steps[first - 1]
    plan = np.reshape(answers[before.episode, before.step].plan, (-1, 2))
    assert np.allclose([step.action for step in steps[first:]], plan[1 : 1 + len(lost)])
    service.fails_when_moving = service.failing = False
    until(lambda: len(steps) > quiet + 20)
    assert not any(step.fallback for step in steps[quiet:])
    assert not any(step.collision for step in steps)


def test_a_fleet_without_the_service_stops_together_and_drives_on_together(scene):
    service, steps, exchanges, start = scene
    start(robots=3, limit=1000, fleet=True, arena="crossing")
    names = ["actor-0.0", "actor-0.1", "actor-0.2"]
    until(lambda: len(steps) >= 30)
    service.fails_when_moving = True
    until(lambda: service.failing)
    quiet = -1
    while quiet != len(steps):  # time passes for all robots or for none
        quiet = len(steps)
        time.sleep(0.5)
    last = {name: [step for step in steps if step.actor == name][-1] for name in names}
    assert len({step.step for step in last.values()}) == 1
    assert all(step.fallback and not any(step.action) for step in last.values())
    service.fails_when_moving = service.failing = False
    until(lambda: len(steps) >= quiet + 30)
    assert not any(step.contact_robot or step.collision for step in steps)
    assert {step.fleet for step in steps} == {3} and not any(step.fallback for step in steps[quiet:])
    assert all(batch == names for batch in service.batches)
    requests = [e.request for e in list(exchanges) if e.request.step and not e.failure]
    assert requests and all(list(r.fleet) == names and r.HasField("reservation") for r in requests)
