"""Only the service can prove that it verified a plan: neither a forged token nor another plan's token does."""

from pathlib import Path

import numpy as np
import pytest

from brakeline.errors import BadKey
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.client import read_reply, request_message
from brakeline.safety.service.filter_client import Answer, accept
from brakeline.safety.service.plan_token import SIZE, PlanAuthenticator, write_key
from brakeline.safety.service.server import ModelRegistry, ServiceCounts, batch_handler
from brakeline.safety.service.wire import decision_of
from tests.robots import GROUND, QUADROTOR

KEY = bytes(range(32))
WALL = Obstacle("cylinder", (0.24, 0.0), (0.1,))  # so near that nothing but a stop could be verified before it
LATE = QUADROTOR.in_real_time()


class Service:
    def __init__(self, model: ModelSet, key: bytes = KEY) -> None:
        self.counts, models = ServiceCounts(), ModelRegistry(accept_bound=1.0)
        models.install(model)
        self._answer = batch_handler(models, self.counts, PlanAuthenticator(key))

    def __call__(self, request: pb.Request) -> pb.Reply:
        payload = pb.RequestBatch(requests=[request]).SerializeToString()
        return pb.ReplyBatch.FromString(self._answer(payload)).replies[0]


def driving(service: Service) -> tuple[BackupPlan, pb.Request]:
    """Return the backup plan of a driving robot, and its next honest request, in front of a wall that has come up."""
    backup_plan = BackupPlan(GROUND)
    request = request_message(backup_plan, np.zeros(5), [0.25, 0.1], known_free=True, actor="actor-0")
    accept(backup_plan, read_reply(service(request), request, GROUND))
    state = np.array(backup_plan.predicted.center)
    return backup_plan, request_message(backup_plan, state, [0.25, 0.0], [WALL], actor="actor-0")


def test_a_request_with_its_token_counts_as_verified(model: ModelSet) -> None:
    service = Service(model)
    _, request = driving(service)
    assert len(request.plan_token) == SIZE
    decision = service(request).decision
    assert (decision.kind, decision.verified, decision.token_rejected) == (pb.FAILSAFE, True, False)
    assert service.counts.token_rejected == 0


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
    service = Service(model)
    _, request = driving(service)
    for name, value in changes.items():
        if isinstance(value, list):
            request.ClearField(name)
            getattr(request, name).extend(value)
        else:
            setattr(request, name, value)
    decision = service(request).decision
    assert (decision.kind, decision.verified, decision.token_rejected) == (pb.FAILSAFE, False, True)
    assert not decision.plan_tokens, "an unverified plan gets no token"
    assert service.counts.token_rejected == 1
    trusting = ModelRegistry(accept_bound=1.0)
    trusting.install(model)
    payload = pb.RequestBatch(requests=[request]).SerializeToString()
    believed = pb.ReplyBatch.FromString(batch_handler(trusting, ServiceCounts())(payload)).replies[0].decision
    assert believed.verified, "without a key it would have counted"


def test_replicas_share_the_key_and_others_do_not(model: ModelSet) -> None:
    first, replica, stranger = Service(model), Service(model), Service(model, KEY[::-1])
    _, request = driving(first)
    assert replica(request).decision.verified
    assert not stranger(request).decision.verified


def test_standing_still_needs_no_token(model: ModelSet) -> None:
    request = request_message(BackupPlan(GROUND), np.zeros(5), [0.0, 0.0], [WALL], actor="actor-0")
    decision = Service(model)(request).decision
    assert decision.verified and not decision.token_rejected


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
        for _ in range(robot.horizon + 2):
            predicted = backup_plan.predicted
            state = np.zeros(robot.state_dim) if predicted is None else predicted.center
            asked = request_message(backup_plan, state, plan[0], known_free=True, actor="a")
            asked = pb.Request.FromString(asked.SerializeToString())
            assert authenticator.is_authentic(asked, robot)
            moving = bool(np.any(backup_plan.plan) or np.any(backup_plan.input_in_force))
            assert bool(asked.model) == moving and len(asked.plan_token) == SIZE
            backup_plan.fallback()


def test_an_unverified_plan_gets_no_token_and_needs_none(model: ModelSet) -> None:
    service = Service(model)
    _, request = driving(service)
    request.model, request.plan_token = UNVERIFIED, b""
    decision = service(request).decision
    assert not decision.verified and not decision.token_rejected and not decision.plan_tokens


def test_the_key_of_the_tokens_is_in_the_folder_of_keys(tmp_path: Path) -> None:
    write_key(tmp_path)
    first = (tmp_path / "vouchers.key").read_bytes()
    write_key(tmp_path)
    assert (tmp_path / "vouchers.key").read_bytes() == first, "it is not drawn anew"
    assert (tmp_path / "vouchers.key").stat().st_mode & 0o077 == 0
    said = pb.Decision(plan=[0.1, 0, 0, 0, 0, 0], model="abc")
    asked = pb.Request(robot="ground")
    made = [
        PlanAuthenticator.of(folder).plan_tokens(asked, said, GROUND) for folder in (tmp_path, tmp_path, None, None)
    ]
    assert made[0] == made[1] and made[2] != made[3] and made[0] != made[2]
    (tmp_path / "vouchers.key").write_bytes(b"short")
    with pytest.raises(BadKey):
        PlanAuthenticator.of(tmp_path)
