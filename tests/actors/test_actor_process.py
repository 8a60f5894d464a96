"""The actor process on a real bus, with a scripted learner and the real core of the safety service."""

import threading
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.actors.actor_process import STOP_PRACTICE, ActorSettings, StopPractice, run
from brakeline.actors.decision_guard import DecisionOutcome
from brakeline.deploy.vehicle_factory import environment, fleet_world
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.topics import DECIDE, EXCHANGE, STEP
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from tests.actors.scripted_learner import ScriptedLearner
from tests.robots import GROUND
from tests.waiting import until

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
        bus.serve(DECIDE, self._decide, robot="ground")

    def _decide(self, payload: bytes, asker: str) -> bytes:
        requests = pb.RequestBatch.FromString(payload).requests
        self.batches.append([request.actor for request in requests])
        self.proposals.append(list(requests[0].action))
        self.failing |= self.fails_when_moving and any(requests[0].input_in_force)
        if self.failing:
            raise RuntimeError("out of order")
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
