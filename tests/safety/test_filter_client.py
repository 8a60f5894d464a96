"""The clients give equal answers in process and by a service; the fleet client decides for all robots, or for none."""

from dataclasses import replace
from inspect import signature

import numpy as np
import pytest

from brakeline.deploy.commands.ros2_command import Ros2Command
from brakeline.errors import BadRequest, SafetyError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.identity import certified_name, identity_of
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.scan import Scan
from brakeline.messaging.topics import DECIDE
from brakeline.safety.filter.backup_plan import BackupPlan, Prediction
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, NOT_FINITE, check_for_filter
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.client import SafetyClient, request_message
from brakeline.safety.service.filter_client import Answer, FilterClient
from brakeline.safety.service.fleet_client import FleetClient
from brakeline.safety.service.in_process import InProcess
from tests.messaging.conftest import endpoint, join  # noqa: F401 - fixtures
from tests.robots import GROUND
from tests.safety.asked import apart, cylinder, request, same
from tests.safety.served import Service, ServiceClient
from tests.safety.test_scan_free_space import FAN
from tests.safety.unicycle import Unicycle

LATE = GROUND.in_real_time()
AHEAD = cylinder(0.34, 0.0)
IN_PROCESS_OR_SERVED = pytest.mark.parametrize(
    "ask", [lambda model: InProcess(Filter(model), accept_bound=1.0), ServiceClient], ids=["in process", "service"]
)


@pytest.fixture(scope="module")
def late(data):
    return fit_model_set(replace(data, robot=LATE), ModelConfig())


def test_an_answer_in_process_is_the_answer_of_a_service(model):
    alone, asked = InProcess(Filter(model), accept_bound=1.0), ServiceClient(model)
    kinds = set()
    for action, away in (([0.1, 0.1], 3.0), ([float("nan"), 0.0], 3.0), ([0.25, 0.0], 0.4), ([0.25, 0.0], 0.3)):
        predicted = alone.backup_plan.predicted
        state = np.zeros(5) if predicted is None else predicted.center
        one, other = (client.decide(state, action, [cylinder(away, 0.0)]) for client in (alone, asked))
        assert type(one) is Answer and same(one, other), (one, other)
        kinds.add(one.kind)
    assert kinds == {"allowed", "adjusted", "failsafe"}


@IN_PROCESS_OR_SERVED
def test_the_action_of_a_late_robot_is_the_input_of_the_next_period(late, ask):
    client = ask(late)
    far = [Obstacle("cylinder", (3.0, 0.0), (0.1,))]
    first = client.decide(np.zeros(5), [0.25, 0.0], far)
    assert first.kind == "allowed" and not first.plan[0].any(), "zero is in force until the answer arrives"
    assert np.array_equal(first.action, [0.25, 0.0]) and np.array_equal(first.action, client.backup_plan.next_input)
    second = client.decide(np.zeros(5), [0.1, 0.2], far)
    assert np.array_equal(second.plan[0], [0.25, 0.0]), "the answer before is in force now"
    assert np.array_equal(second.action, client.backup_plan.next_input)


WALL = Scan(np.full(360, 0.13), FAN, (0.0, 0.0, 0.0))  # 13 cm away all round


def unsent(model):
    """Return a client without a bus: it refuses bad values before it sends a request."""
    return SafetyClient(None, model.robot)


@pytest.fixture(params=[lambda model: InProcess(Filter(model), accept_bound=1.0), unsent], ids=["in process", "client"])
def client(request, model):
    return request.param(model)


def test_without_a_decision_every_client_goes_on_with_its_backup_plan(client):
    client.backup_plan.accept(np.array([[0.2, 0.1], [0.1, 0.0], [0.0, 0.0]]), "version", None, True)
    assert np.array_equal(client.fallback(), [0.1, 0.0])
    client.reset()
    assert not client.backup_plan.input_in_force.any()


def test_a_caller_may_overwrite_the_arrays_that_it_gives_and_gets(client):
    """A driver scales the returned input to its own unit in place; the next request must have it as executed."""
    state, plan = np.zeros(5), np.array([[0.2, 0.1], [0.1, 0.0], [0.0, 0.0]])
    predicted = Prediction(np.zeros(5), np.full(5, 0.1), 0.0)
    client.backup_plan.measured(state)
    state += 1.0
    assert not client.backup_plan.seen.any()
    client.backup_plan.accept(plan, "v", predicted, True)
    predicted.center[:2] += 100.0  # to a map's origin
    assert client.backup_plan.still_verified and not client.backup_plan.predicted.center.any()
    for step in (lambda: client.backup_plan.accept(plan, "v", None, True), client.fallback):
        returned = step()
        executed = returned.copy()
        returned *= 0.5
        assert np.array_equal(client.backup_plan.input_in_force, executed)


def test_the_clients_have_the_same_parameters():
    wanted = list(signature(FilterClient.decide).parameters.values())
    for kind in (SafetyClient, InProcess):
        own = list(signature(kind.decide).parameters.values())
        assert own[: len(wanted)] == wanted
        assert all(p.kind is p.KEYWORD_ONLY for p in own[4:])


@pytest.mark.parametrize(
    ("field", "more", "said"),
    [
        ("obstacles", {"obstacles": WALL}, "give it as scan="),
        ("obstacles", {"obstacles": AHEAD}, "give a list of Obstacle"),
        ("obstacles", {"obstacles": [AHEAD, (0.3, 0.0)]}, "holds a tuple"),
        ("obstacles", {"obstacles": [WALL]}, "holds a Scan"),
        ("obstacles", {"obstacles": 3.0}, "is a float"),
        ("scan", {"scan": [AHEAD]}, "is a list: give a Scan"),
        ("scan", {"scan": np.ones(360)}, "is a ndarray: give a Scan"),
        ("observation", {"observation": WALL, "known_free": True}, "give it as scan="),
        ("observation", {"observation": {"rays": 1}, "known_free": True}, "is a dict"),
        ("observation", {"observation": np.zeros((3, 3)), "known_free": True}, "shape"),
        ("known_free", {"known_free": "yes"}, "is a str"),
        ("known_free", {"known_free": []}, "is a list"),
    ],
)
def test_a_value_of_another_type_is_refused_with_its_field(client, field, more, said):
    with pytest.raises(BadRequest, match=said) as caught:
        client.decide(np.zeros(5), [0.25, 0.0], **more)
    assert caught.value.field == field


@pytest.mark.parametrize("field", ["state", "action"])
@pytest.mark.parametrize(
    "value",
    [
        *(None, 0.2, "abc", ["0.1", "0.2"], {}, [[0.1, 0.2]], [0.1, [0.2]], np.array([0.1 + 1j, 0.2])),
        *([object()] * 2, [10**400] * 2),
    ],
    ids=["none", "number", "text", "texts", "dict", "nested", "ragged", "complex", "objects", "no double"],
)
def test_a_vector_of_another_type_is_refused_with_its_field(client, field, value):
    with pytest.raises(BadRequest, match=f"{field} .*: give a list of numbers") as caught:
        client.decide(**{"state": np.zeros(5), "action": [0.25, 0.0], field: value}, known_free=True)
    assert caught.value.field == field


def test_a_masked_number_is_missing(ready):
    """NumPy drops a mask without a word, and what lies below it is any number."""
    state, action = np.ma.array(np.zeros(5), mask=[0, 1, 0, 0, 0]), np.ma.array([0.25, 0.0], mask=[1, 0])
    safety = InProcess(ready, accept_bound=1.0)
    assert safety.decide(np.zeros(5), action, known_free=True).reason == NOT_FINITE
    with pytest.raises(BadRequest, match="state holds NaN"):
        safety.decide(state, [0.25, 0.0], known_free=True)


def test_a_deadline_that_no_query_can_have_is_refused(join, endpoint):  # noqa: F811
    bus = join("safety", listen=True)
    for deadline in (float("nan"), float("inf"), -1.0, 0.0, 1e300, None, "0.1"):
        with pytest.raises(ValueError, match="a deadline is"):
            SafetyClient(bus, "ground", deadline)
        with pytest.raises(ValueError, match="a deadline is"):
            FleetClient(bus, "ground", NAMES, deadline)
        with pytest.raises(ValueError, match="a deadline is"):
            SafetyClient.open(endpoint, "ground", deadline)


@pytest.mark.parametrize(
    ("field", "value"),
    [("episode", -1), ("step", 2**40), ("step", 1.5), ("actor", 3), ("time", "now"), ("fleet", [1, 2])],
)
def test_a_label_of_another_type_is_refused_with_its_field(field, value):
    with pytest.raises(BadRequest, match="give texts as actor and fleet, whole numbers from 0 as episode") as caught:
        request_message(BackupPlan(GROUND), np.zeros(5), np.zeros(2), **{field: value})
    assert caught.value.field == field


def test_a_client_takes_the_path_of_a_description(join):  # noqa: F811
    assert SafetyClient(join("client", listen=True), ROBOTS_FOLDER / "ground.toml").robot.layout() == GROUND.layout()


@IN_PROCESS_OR_SERVED
def test_a_request_without_obstacles_scan_or_map_is_refused(model, ask):
    """An empty list or a dropped scan does not mean that space is free."""
    client = ask(model)
    for space in ((), (None,), ([],)):
        with pytest.raises((BadRequest, SafetyError), match="known_free") as caught:
            client.decide(np.zeros(5), [0.25, 0.0], *space)
        assert caught.value.field == "obstacles"
    assert client.decide(np.zeros(5), [0.25, 0.0], known_free=True).kind == "allowed"
    for known_free in (False, True):
        client.backup_plan.reset()
        answer = client.decide(np.zeros(5), [0.25, 0.0], [], scan=WALL, known_free=known_free)
        assert answer.kind == "failsafe", "the scan counts"


def test_the_quick_check_and_the_full_check_both_need_known_space(ready):
    predicted = Prediction(np.zeros(5), np.full(5, 0.1), 0.0)
    for silent in (request(known_free=False), request(known_free=False, predicted=predicted)):
        assert ready.ordinary(silent), "the request is valid apart from that"
        for check in (ready.decide, lambda asked: check_for_filter(GROUND, asked)):
            with pytest.raises(BadRequest) as caught:
                check(silent)
            assert caught.value.field == "obstacles"
    walker = Obstacle("cylinder", (0.9, 0.0), (0.2,), motion=Motion((0.0, 0.0), 0.05, speed=0.5))
    assert ready.decide(replace(silent, movers=MovingObstacles.of([walker], 2))).kind in (ALLOWED, ADJUSTED, FAILSAFE)


# --- a fleet: a client decides for all robots of a world, or for none -----------------------------------------------

POST = Obstacle("cylinder", (0.0, 0.8), (0.1,))
NAMES = ("left", "right")


def facing():
    """Return two robots half a metre apart that face each other."""
    rng = np.random.default_rng(0)
    return [Unicycle((-0.25, 0.0, 0.0), rng, noise=0.0), Unicycle((0.25, 0.0, np.pi), rng, noise=0.0)]


def decided(fleet, robots, actions):
    return fleet.decide([r.measure() for r in robots], actions, [[POST], [POST]])


@pytest.fixture
def fleet(model):
    return FleetClient(Service(model), "ground", NAMES)


def test_two_robots_that_drive_at_each_other_do_not_meet(fleet):
    robots, moved = facing(), 0.0
    for _ in range(15):
        answers = decided(fleet, robots, [[0.25, 0.0], [0.25, 0.0]])
        for robot, answer in zip(robots, answers, strict=True):
            robot.step(answer.action)
        moved = max(moved, robots[0].state[0] + 0.25)
        one, other = (backup_plan.reservation for backup_plan in fleet.backup_plans)
        assert apart(one, other) > 0.0
        assert np.hypot(*(robots[0].state[:2] - robots[1].state[:2])) > 2.0 * GROUND.footprint
    assert moved > 0.02, "they stood all the time"
    fleet.reset()
    assert all(backup_plan.reservation is None and not backup_plan.plan.any() for backup_plan in fleet.backup_plans)


def test_without_a_decision_for_one_robot_no_robot_has_one(fleet):
    robots = facing()
    answers = decided(fleet, robots, [[0.1, 0.0], [0.1, 0.0]])
    for robot, answer in zip(robots, answers, strict=True):
        robot.step(answer.action)
    before = [(backup.plan.copy(), backup.input_in_force, backup.reservation) for backup in fleet.backup_plans]
    with pytest.raises(SafetyError) as caught:
        decided(fleet, robots, [[0.2, 0.3], [0.0]])
    assert caught.value.field == "action"
    for backup, (plan, in_force, reservation) in zip(fleet.backup_plans, before, strict=True):
        assert np.array_equal(backup.plan, plan)
        assert backup.input_in_force is in_force and backup.reservation is reservation
    inputs = fleet.fallback()
    assert all(np.array_equal(executed, plan[0]) for executed, (plan, *_) in zip(inputs, before, strict=True))
    for robot, executed in zip(robots, inputs, strict=True):
        robot.step(executed)
    assert [a.verified for a in decided(fleet, robots, [[0.1, 0.0], [0.1, 0.0]])] == [True, True]


def test_the_first_robot_changes_each_period(fleet, monkeypatch):
    queries = []
    monkeypatch.setattr(fleet.bus, "ask", lambda key, payload, *_, **__: queries.append(payload) or b"")
    for _ in range(3):
        with pytest.raises(SafetyError):
            fleet.decide([np.zeros(5), np.ones(5)], [[0.1, 0.0]] * 2, [[], []])
        fleet.fallback()
    requests = [pb.RequestBatch.FromString(payload).requests for payload in queries]
    assert [[(r.step, r.actor, tuple(r.fleet)) for r in batch] for batch in requests] == [
        [(i, name, NAMES) for name in NAMES] for i in range(3)
    ]


def test_a_fleet_needs_known_free_space(fleet):
    robots = facing()
    decided(fleet, robots, [[0.0, 0.1]] * 2)
    fleet.reset()
    questions = [r.measure() for r in robots], [[0.0, 0.1]] * 2
    with pytest.raises(SafetyError, match="known_free") as caught:
        fleet.decide(*questions)
    assert caught.value.field == "obstacles"
    fleet.fallback()
    assert [answer.kind for answer in fleet.decide(*questions, known_free=True)] == ["allowed", "allowed"]
    fleet.reset()
    walls = [replace(WALL, pose=tuple(state[:3])) for state in questions[0]]
    assert {answer.kind for answer in fleet.decide(*questions, scans=walls)} == {"failsafe"}


@pytest.mark.parametrize("name", ["states", "actions", "obstacles", "scans"])
def test_a_fleet_needs_an_entry_for_each_robot_and_the_error_names_what_lacks_one(fleet, name):
    given = {"states": [np.zeros(5)] * 2, "actions": [np.zeros(2)] * 2, "obstacles": [[], []], "scans": [None, None]}
    with pytest.raises(ValueError, match=f"{name} has 3 entries: give one for each of {', '.join(NAMES)}"):
        fleet.decide(**(given | {name: given[name] + given[name][:1]}), known_free=True)


def test_robots_of_a_fleet_may_share_an_iterator_of_obstacles(fleet):
    """The second robot would find it empty, as if all space were free."""
    near = iter([Obstacle("box", (0.25, 0.0), (0.2, 2.0))])
    robots = facing()
    decided(fleet, robots, [[0.0, 0.0]] * 2)
    fleet.reset()
    answers = fleet.decide([r.measure() for r in robots], [[0.25, 0.0]] * 2, [near, near], known_free=True)
    assert not answers[1].verified or answers[1].kind == "failsafe"


def test_clients_with_the_default_name_get_their_own_turns_at_the_service(join, endpoint):  # noqa: F811
    """Two dozen robots under one name would lose half of their queries: a service keeps 8 of each name."""
    join("safety", listen=True)
    with SafetyClient.open(endpoint, "ground") as one, FleetClient.open(endpoint, "ground", NAMES) as other:
        sources = one.bus.source, other.bus.source
    assert len(set(map(identity_of, sources))) == 2 and set(map(certified_name, sources)) == {"client"}
    with SafetyClient.open(endpoint, "ground", name="robot-7") as named:
        assert named.bus.source == "robot-7"


def test_ros_nodes_with_the_default_name_get_their_own_turns_too(join, endpoint, model):  # noqa: F811
    askers, service = [], Service(model)
    join("safety", listen=True).serve(DECIDE, lambda payload, asker: askers.append(asker) or service.answer(payload))
    for node in ({}, {}, {"name": "mine"}):
        with Ros2Command(connect=(endpoint,), **node)._asker(GROUND, lead=30.0) as ask:
            ask([pb.Request(robot="ground")])
    assert len(set(map(identity_of, askers))) == 3 and askers[2] == "mine"


def test_a_malformed_fleet_is_refused(fleet):
    for names in ((), ("alone",), ("same", "same"), "left"):
        with pytest.raises(ValueError, match="two robots or more"):
            FleetClient(fleet.bus, "ground", names)
    with pytest.raises(ValueError, match="ground-late gets its decisions too late for reservations"):
        FleetClient(fleet.bus, "ground-late", NAMES)
    with pytest.raises(ValueError, match="at most 64 robots, not 65: a service refuses more"):
        FleetClient(fleet.bus, "ground", [f"robot-{i}" for i in range(65)])


def test_a_name_is_no_model_set_and_the_error_says_what_to_give() -> None:
    with pytest.raises(TypeError, match=r"not a str: give Filter.load\(NAME_OR_PATH\)"):
        Filter("ground")
