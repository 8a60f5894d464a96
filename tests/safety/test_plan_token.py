"""Only the service can prove that it verified a plan: neither a forged token nor another plan's token does."""

from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.errors import BadKeys, NoReply
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Robot
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.client import SafetyClient, read_reply, request_message
from brakeline.safety.service.filter_client import Answer, accept
from brakeline.safety.service.plan_token import SIZE, PlanAuthenticator, write_key
from brakeline.safety.service.wire import decision_of
from tests.messaging.conftest import endpoint, join  # noqa: F401 - fixtures
from tests.robots import GROUND, QUADROTOR
from tests.safety.served import Service, with_fields

KEY = bytes(range(32))
WALL = Obstacle("cylinder", (0.24, 0.0), (0.1,))  # so near that nothing but a stop could be verified before it
LATE = QUADROTOR.in_real_time()


def reply(service: Service, request: pb.Request, *asker: str) -> pb.Reply:
    """Return the reply to a request, from within the process or from an asker whose name the router has checked."""
    batch = service.answer(pb.RequestBatch(requests=[request]).SerializeToString(), *asker)
    return pb.ReplyBatch.FromString(batch).replies[0]


def driving(service: Service, *asker: str) -> pb.Request:
    """Return the next honest request of a driving robot, in front of a wall that has come up."""
    backup_plan = BackupPlan(GROUND)
    request = request_message(backup_plan, np.zeros(5), [0.25, 0.1], known_free=True, actor="actor-0")
    accept(backup_plan, read_reply(reply(service, request, *asker), request, GROUND))
    state = np.array(backup_plan.predicted.center)
    return request_message(backup_plan, state, [0.25, 0.0], [WALL], actor="actor-0")


def test_a_request_with_its_token_counts_as_verified_wherever_the_key_is_known(model: ModelSet) -> None:
    first, replica, stranger = (Service(model, key=key) for key in (KEY, KEY, KEY[::-1]))
    request = driving(first)
    assert len(request.plan_token) == SIZE
    for service in (first, replica):
        decision = service.decision(request)
        assert (decision.kind, decision.verified, decision.token_rejected) == (pb.FAILSAFE, True, False)
        assert service.counts.token_rejected == 0
    assert not stranger.decision(request).verified


FORGERIES = {
    "made up": {"plan_token": b"\0" * SIZE},
    "none": {"plan_token": b""},
    "short": {"plan_token": b"\0"},
    "another actor's": {"actor": "actor-1"},
    "another plan": {"plan": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]},
    "from another input": {"input_in_force": [0.2, 0.1]},
    "another prediction": {"predicted_half_width": [9.0] * 5},
    "no prediction": {"predicted_half_width": [], "predicted_center": [], "predicted_heading": 0.0},
    "of another heading": {"predicted_heading": 0.5},
}


@pytest.mark.parametrize("changes", FORGERIES.values(), ids=FORGERIES.keys())
def test_a_forged_request_does_not_count_as_verified(model: ModelSet, changes: dict[str, object]) -> None:
    """In front of a wall, where no new plan can be verified."""
    service = Service(model, key=KEY)
    request = with_fields(driving(service), **changes)
    decision = service.decision(request)
    assert (decision.kind, decision.verified, decision.token_rejected) == (pb.FAILSAFE, False, True)
    assert not decision.plan_tokens, "an unverified plan gets no token"
    assert service.counts.token_rejected == 1
    assert Service(model).decision(request).verified, "without a key it counts"


def plan_of(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """Return a plan that ends in a stop, with some zeros negative."""
    plan = rng.uniform(robot.low(), robot.high(), (robot.horizon, robot.action_dim)) * rng.integers(0, 2, (1,))
    plan[rng.integers(1, robot.horizon) :] = 0.0
    return np.where(rng.random(plan.shape) < 0.2, -0.0, plan)


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR, LATE], ids=lambda robot: robot.name)
def test_each_period_has_its_token_until_the_robot_stands(robot: Robot) -> None:
    """Without a better plan, the backup plan continues, and each request on the way has a valid token."""
    authenticator, rng = PlanAuthenticator(KEY), np.random.default_rng(0)
    for _ in range(50):
        backup_plan, plan = BackupPlan(robot), plan_of(robot, rng)
        request = pb.Request(robot=robot.name, actor="a")
        decision = pb.Decision(plan=plan.ravel().tolist(), model="abc", verified=True, predicted_heading=-0.0)
        decision.kind = pb.ALLOWED
        decision.predicted_center.extend(rng.normal(size=robot.state_dim).tolist())
        decision.predicted_half_width.extend(rng.random(robot.state_dim).tolist())
        decision.plan_tokens.extend(authenticator.plan_tokens(request, decision, robot))
        wire = pb.Decision.FromString(decision.SerializeToString())
        accept(backup_plan, Answer.of(decision_of(wire, robot), robot, plan_tokens=tuple(wire.plan_tokens)))
        stopped = robot.horizon  # periods of a stop's inputs
        for _ in range(2 * robot.horizon + 2):
            stopped = 0 if np.any(backup_plan.input_in_force) else stopped + 1
            predicted = backup_plan.predicted
            state = np.zeros(robot.state_dim) if predicted is None else predicted.center
            message = request_message(backup_plan, state, plan[0], known_free=True, actor="a")
            message = pb.Request.FromString(message.SerializeToString())
            assert authenticator.is_authentic(message, robot)
            moving = bool(np.any(backup_plan.plan)) or stopped < robot.horizon
            assert bool(message.model) == moving and len(message.plan_token) == SIZE
            backup_plan.fallback()


def test_an_unverified_plan_gets_no_token_and_needs_none(model: ModelSet) -> None:
    service = Service(model, key=KEY)
    request = driving(service)
    request.model, request.plan_token = UNVERIFIED, b""
    decision = service.decision(request)
    assert not decision.verified and not decision.token_rejected and not decision.plan_tokens


def test_the_key_of_the_tokens_is_in_the_folder_of_keys(tmp_path: Path) -> None:
    write_key(tmp_path)
    first = (tmp_path / "vouchers.key").read_bytes()
    write_key(tmp_path)
    assert (tmp_path / "vouchers.key").read_bytes() == first, "a second call keeps the key"
    assert (tmp_path / "vouchers.key").stat().st_mode & 0o077 == 0
    decision, request = pb.Decision(plan=[0.1, 0, 0, 0, 0, 0], model="abc"), pb.Request(robot="ground")
    authenticators = map(PlanAuthenticator.of, (tmp_path, tmp_path, None, None))
    tokens = [one.plan_tokens(request, decision, GROUND) for one in authenticators]
    assert tokens[0] == tokens[1] and tokens[2] != tokens[3] and tokens[0] != tokens[2]
    (tmp_path / "vouchers.key").write_bytes(b"short")
    with pytest.raises(BadKeys):
        PlanAuthenticator.of(tmp_path)


def test_a_token_is_of_use_to_the_asker_that_got_it(model: ModelSet) -> None:
    """The router has compared the asker's name with its certificate; the name in the request it has not."""
    service = Service(model, key=KEY)
    for issued_to, owners, thieves in (
        ((), ((),), ("actor-1",)),
        (("actor-0",), (("actor-0",), ("actor-0.3",)), ("actor-1", "actor-00", "client", "")),
    ):
        request = driving(service, *issued_to)
        for owner in owners:
            assert not reply(service, request, *owner).decision.token_rejected, owner
        for thief in thieves:
            assert reply(service, request, thief).decision.token_rejected, thief


def test_over_a_live_bus_a_stolen_plan_counts_as_unverified(join, endpoint, model: ModelSet) -> None:  # noqa: F811
    """The thief has read all messages of another client, and asks in its name."""
    service = Service(model, key=KEY)
    join("safety", listen=True).serve(DECIDE, service.answer)

    def decide(client: SafetyClient, *words: Any, **more: Any) -> Answer:
        while True:
            with suppress(NoReply):  # the service is not yet known on this side
                return client.decide(*words, **more)

    with (
        SafetyClient.open(endpoint, "ground", 5.0, name="actor-0") as owner,
        SafetyClient.open(endpoint, "ground", 5.0, name="actor-1") as thief,
    ):
        assert decide(owner, np.zeros(5), [0.25, 0.1], known_free=True, actor="actor-0").verified
        state = np.array(owner.backup_plan.predicted.center)
        thief.backup_plan = deepcopy(owner.backup_plan)
        assert len(thief.backup_plan.plan_token) == SIZE
        for client, verified in ((thief, False), (owner, True)):
            answer = decide(client, state, [0.25, 0.0], [WALL], actor="actor-0")
            assert (answer.kind, answer.verified, answer.token_rejected) == ("failsafe", verified, not verified)
    assert service.counts.token_rejected == 1
