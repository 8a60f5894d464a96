"""A robot's description: what is right comes back the same, and every mistake is told by its field."""

import copy
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.errors import BadDescription, UnknownRobot, UnknownTask
from brakeline.messaging.description_model import UNITS
from brakeline.messaging.robot import Disc, Robot, refuse_shipped_name, robot_named
from brakeline.messaging.robot_description import describe, read_robot, robot_from_description
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import needs_task, read_task, robot_maybe_with_task, robot_with_task
from tests.robots import GROUND, ROBOTS

pytestmark = pytest.mark.fast

CAR = {
    "name": "car",
    "period": 0.1,
    "sight": 3.0,
    "state": {
        "x": {"unit": "m", "role": "position", "error": 0.01},
        "y": {"unit": "m", "role": "position", "error": 0.01},
        "heading": {"unit": "rad", "role": "heading", "error": 0.02},
        "speed": {"unit": "m/s", "error": 0.02, "follows": "speed"},
        "steering": {"unit": "rad", "error": 0.02, "follows": "steering"},
    },
    "input": {
        "speed": {"unit": "m/s", "low": -0.5, "high": 1.0, "slew": 0.25},
        "steering": {"unit": "rad", "low": -0.5, "high": 0.5, "moves": False, "stop": "hold"},
    },
    "plan": {"horizon": 8, "free": 1, "brake": 5},
    "body": [{"at": [0.0, 0.0], "radius": 0.15}, {"at": [0.25, 0.0], "radius": 0.15}],
    "limit": [{"name": "keep in", "weights": {"x": 1.0}, "most": 5.0}],
}


def turning(left, right=None):
    """Return limits of the heading [rad]."""
    sides = ((1.0, left),) if right is None else ((1.0, left), (-1.0, right))
    return [{"name": f"{weight}", "weights": {"heading": weight, "x": 0.0}, "most": most} for weight, most in sides]


def changed(*path_and_value):
    *path, last, value = path_and_value
    description = copy.deepcopy(CAR)
    place = description
    for part in path:
        place = place[part]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return description


@pytest.mark.parametrize("robot", [robot_named(name) for name in ROBOTS], ids=ROBOTS)
def test_a_description_makes_the_same_robot_again(robot):
    assert robot_from_description(json.loads(json.dumps(robot.description))) == robot
    assert robot.in_real_time().in_lockstep() == robot
    assert read_robot(ROBOTS_FOLDER / f"{robot.name}.toml") == robot


def test_what_a_description_says_is_what_the_robot_has():
    car = robot_from_description(CAR)
    assert car.state == ("x [m]", "y [m]", "heading [rad]", "speed [m/s]", "steering [rad]")
    assert (car.position_dim, car.heading, car.regressor, car.follows) == (2, 2, (3, 4), (3, 4))
    assert car.stop == ("ramp", "hold") and list(car.zero_at_rest) == [True, False]
    assert car.footprint == pytest.approx(0.4)
    plan = (car.plan_matrix() @ [1.0, 0.3]).reshape(8, 2)
    assert plan[:, 0] == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2, 0.0, 0.0, 0.0])
    assert plan[:, 1] == pytest.approx(0.3), "a car keeps its steering while it brakes"
    assert car.is_stop_input(plan[-1]) and not car.is_stop_input(plan[3])
    assert robot_from_description(describe(car)) == car


@pytest.mark.parametrize(
    ("said", "field", "word"),
    [
        (changed("period", ...), "period", "missing"),
        (changed("period", 0.0), "period", "greater"),
        (changed("period", "fast"), "period", "number"),
        (changed("periods", 0.1), "periods", "did you mean 'period'"),
        (changed("name", "a/b"), "name", "letters"),
        (changed("name", "car-late"), "name", "-late"),
        (changed("name", ".."), "name", "letters"),
        (changed("name", "."), "name", "letters"),
        (changed("sight", math.inf), "sight", "finite"),
        (changed("state", "x", "unit", "cm"), "state.x.unit", "SI"),
        (changed("state", "x", "unit", "rad"), "state.x.unit", "position is in m"),
        (changed("state", "heading", "unit", "deg"), "state.heading.unit", "SI"),
        (changed("state", "x", "role", "place"), "state.x.role", "position"),
        (changed("state", "x", "error", -1.0), "state.x.error", "greater"),
        (changed("state", "x", "error", ...), "state.x.error", "missing"),
        (changed("state", "x", "regressor", True), "state.x.regressor", "displacement"),
        (changed("state", "speed", "follows", "throttle"), "state.speed.follows", "one of the inputs"),
        (changed("state", "speed", "follows", "steering"), "state.speed.follows", "in 'm/s'"),
        (changed("state", "y", "role", "other"), "state", "two or three"),
        (changed("input", "speed", "low", 2.0), "input.speed.high", "above low"),
        (changed("input", "speed", "low", 0.2), "input.speed.low", "zero input"),
        (changed("input", "speed", "slew", 0.1), "input.speed.slew", "can't follow the ramp"),
        (changed("input", "speed", "slew", -0.1), "input.speed.slew", "greater"),
        (changed("input", "speed", "stop", [0.5, 0.2]), "input.speed.stop", "ends in 0"),
        (changed("input", "speed", "stop", [-2.0, 0.0]), "input.speed.stop", "leaves the bounds"),
        (changed("input", "speed", "stop", {"x": -4.0}), "input.speed.stop", "gains on speeds"),
        (changed("input", "speed", "stop", {"speed": -4.0}), "input.speed.stop", "`stopped`"),
        (changed("input", "speed", "stop", "coast"), "input.speed.stop", "ramp"),
        (changed("input", "speed", "unit", "km/h"), "input.speed.unit", "SI"),
        (changed("plan", "horizon", 5), "plan.horizon", "at least 6"),
        (changed("plan", "brake", 0), "plan.brake", "greater"),
        (changed("plan", "horizon", 4.5), "plan.horizon", "integer"),
        (changed("body", []), "body", "at least 1"),
        (changed("body", 0, "radius", 0.0), "body.0.radius", "greater"),
        (changed("body", 0, "at", [0.0, 0.0, 0.0]), "body.0.at", "the position has 2"),
        (changed("limit", 0, "weights", {"z": 1.0}), "limit.0.weights", "names of state coordinates"),
        (changed("limit", 0, "weights", {}), "limit.0.weights", "names of state coordinates"),
        (changed("limit", 2 * CAR["limit"]), "limit.1.name", "another limit is called 'keep in'"),
        (changed("limit", turning(3.3)), "limit.0.weights", "also give the limit of the other side"),
        (changed("limit", turning(3.3, 3.0)), "limit.1.most", "must be less than 2 pi apart"),
        (changed("body", 0, "radius", True), "body.0.radius", "a number, not True"),
        (changed("body", 0, "at", [0.0, False]), "body.0.at", "a number, not False"),
        (changed("state", "x", "error", True), "state.x.error", "a number, not True"),
        (changed("input", "speed", "high", True), "input.speed.high", "a number, not True"),
        (changed("plan", "free", True), "plan.free", "a number, not True"),
        (changed("period", True), "period", "a number, not True"),
    ],
)
def test_a_mistake_is_told_by_its_field(said, field, word):
    with pytest.raises(BadDescription) as caught:
        robot_from_description(said, "my.toml")
    messages = [text for place, text in caught.value.problems if place == field or place.startswith(f"{field}.")]
    assert any(word in text for text in messages), caught.value.problems
    assert field in str(caught.value) and "my.toml" in str(caught.value)


def test_all_mistakes_are_told_at_once():
    description = changed("period", -1.0)
    description["state"]["x"]["unit"] = 3
    del description["plan"]
    with pytest.raises(BadDescription) as caught:
        robot_from_description(description)
    assert {"period", "state.x.unit", "plan"} <= {field for field, _ in caught.value.problems}


@pytest.mark.parametrize("rule", ["rmap", 3, [0.5, "x", 0.0], {"speed": "x"}])
def test_a_wrong_stop_rule_is_one_mistake_in_words_of_the_file(rule):
    with pytest.raises(BadDescription) as caught:
        robot_from_description(changed("input", "speed", "stop", rule))
    ((field, text),) = caught.value.problems
    assert field == "input.speed.stop" and "'ramp', 'hold', fractions" in text and repr(rule) in text


def test_a_description_that_is_no_table_is_refused():
    with pytest.raises(BadDescription, match="dictionary"):
        robot_from_description([])


VALUES = (
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5) | st.lists(st.floats(), max_size=3)
)
PLACES = [
    *[(name,) for name in CAR],
    *[("state", name, field) for name in CAR["state"] for field in ("unit", "role", "error", "follows", "regressor")],
    *[("input", name, field) for name in CAR["input"] for field in ("unit", "low", "high", "moves", "slew", "stop")],
    *[("plan", field) for field in CAR["plan"]],
    *[("body", 0, field) for field in ("at", "radius")],
    *[("limit", 0, field) for field in ("name", "weights", "most")],
]


@given(st.sampled_from(PLACES), VALUES)
def test_whatever_stands_in_a_field_makes_a_sound_robot_or_is_told(place, value):
    description = changed(*place, value)
    try:
        robot = robot_from_description(description)
    except BadDescription as error:
        assert error.problems
        return
    assert robot_from_description(describe(robot)) == robot
    assert np.isfinite(robot.plan_matrix()).all() and robot.is_stop_input(
        (robot.plan_matrix() @ np.tile(robot.high(), 1)).reshape(robot.horizon, -1)[-1]
    )
    assert robot.horizon >= robot.free_steps + robot.brake_steps and robot.footprint > 0.0
    assert all(label.endswith("]") and label[label.rindex("[") + 1 : -1] in UNITS for label in robot.state)


def test_a_file_is_found_by_its_path_and_never_by_its_name(tmp_path):
    text = (ROBOTS_FOLDER / "ground.toml").read_text().replace('name = "ground"', 'name = "minted"')
    (tmp_path / "my.toml").write_text(text)
    robot = robot_named(str(tmp_path / "my.toml"))
    assert robot.name == "minted" and robot == replace(robot_named("ground"), name="minted")
    assert robot_named(tmp_path / "my.toml") == robot, "a path need not be a text"
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert robot_named(tmp_path / "marked.toml") == robot, "an editor of Windows wrote it"
    assert robot_named(f"{tmp_path / 'my.toml'}-late") == robot.in_real_time()
    with pytest.raises(UnknownRobot, match=r"no robot is called 'minted'.*ground") as caught:
        robot_named("minted")
    assert caught.value.field == "robot"
    with pytest.raises(UnknownTask, match="minted has no task"):
        robot_with_task(tmp_path / "my.toml")
    assert robot_maybe_with_task(str(tmp_path / "my.toml")) == robot
    with pytest.raises(UnknownTask, match="minted has no task"):
        needs_task(robot)
    (tmp_path / "my.toml").write_text(text.replace("minted", "dented"))
    assert robot_named(str(tmp_path / "my.toml")).name == "dented", "a file that changed is read again"
    with pytest.raises(UnknownRobot, match=r"nowhere\.toml"):
        robot_named(str(tmp_path / "nowhere.toml"))
    (tmp_path / "broken.toml").write_text("name = ")
    with pytest.raises(BadDescription, match=r"description:\n  not TOML"):
        robot_named(str(tmp_path / "broken.toml"))


def test_nobody_takes_the_name_of_a_robot_that_comes_with_the_program():
    description = copy.deepcopy(GROUND.description)
    description["sight"] = 0.1
    with pytest.raises(UnknownRobot, match="choose another"):
        refuse_shipped_name(robot_from_description(description))
    assert refuse_shipped_name(GROUND) is GROUND


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("progress = 20.0", "progres = 20.0", r"reward\.progres: unknown: check its spelling"),
        ("[lidar]", "[radar]", "radar"),
        ("[reward]", "[reward]\ncorrection_penalty = nan", "a penalty is finite and not negative"),
        ("half_width = 2.5", "", r"arenas\.default\.half_width: missing"),
        ("half_width = 2.5", 'half_width = "wide"', r"arenas\.default\.half_width"),
        ("progress = 20.0", "progress = nan", r"reward: progress = nan is not finite"),
        ("progress = 20.0", "collision = 100.0", r"reward: collision = 100\.0 is not 0 or less"),
        ("step_limit = 300", "step_limit = 0", r"arenas\.default: step_limit = 0 is not 1 or more"),
        ("step_limit = 300", "step_limit = 300\ngoal_radius = nan", r"arenas\.default: goal_radius = nan is not fin"),
        ("step_limit = 300", "step_limit = 300\ngoal_radius = -1", r"goal_radius = -1\.0 is not above 0"),
        ("step_limit = 300", "step_limit = 300\nstart_clearance = -0.2", r"start_clearance = -0\.2 is not 0 or more"),
        ("count = [3, 4]", "count = [4, 3]", r"arenas\.walkers\.movers: count = \[4, 3\] has the largest number first"),
        ("half_width = 2.5", "half_width = nan", r"half_width = nan is not finite"),
        ("radius = [0.1, 0.2]", "radius = [0.2, 0.1]", r"radius = \[0\.2, 0\.1\] has the largest number first"),
        ("radius = [0.1, 0.2]", "radius = [0.0, 0.1]", r"radius = \[0\.0, 0\.1\] is not above 0"),
        ("cylinders = [3, 5]", "cylinders = [5, 3]", r"cylinders = \[5, 3\] has the largest number first"),
        ("cylinders = [3, 5]", "cylinders = [-3, 5]", r"cylinders = \[-3, 5\] is not 0 or more"),
        ("goal_distance = 1.5", "goal_distance = -1.5", r"goal_distance = -1\.5 is not above 0"),
        ("range = 3.5", "range = 0", r"lidar: range = 0\.0 is not above 0"),
        ("range = 3.5", "range = nan", r"lidar: range = nan is not finite"),
        ("fan = 18", "fan = 18\nazimuths = 4\nelevations = 3", r"lidar: .*fan = 18.*azimuths = 4"),
        ("fan = 18", "azimuths = 4", r"lidar: .*azimuths = 4.*elevations = 0"),
        ("trajectories = 200", "at_once = 0", r"at_once = 0 is not 1 or more"),
        ("trajectories = 200", "trajectories = -1", r"trajectories = -1 is not 1 or more"),
        ("steps = 60_000", "steps = -1", r"steps = -1 is not 1 or more"),
        ("threshold = 0.05", "threshold = inf", r"rivals: threshold = inf is not finite"),
        ("margins = [0.02,", "margins = [nan,", r"rivals: margins = \[nan, .* is not finite"),
        ('dense]\nlike = "default"', 'dense]\nlike = "defualt"', r"arenas\.dense: no arena is called 'defualt'"),
        ('dense]\nlike = "default"', 'dense]\nlike = "dense"', r"arenas\.dense: it is like itself"),
    ],
)
def test_a_task_names_the_key_and_the_value_that_make_no_sense(tmp_path, before, after, said):
    text = (ROBOTS_FOLDER / "ground.task.toml").read_text()
    assert before in text
    (tmp_path / "a.task.toml").write_text(text.replace(before, after, 1))
    with pytest.raises(UnknownTask, match=said):
        read_task(tmp_path / "a.task.toml")


def test_a_task_cannot_be_like_itself(tmp_path):
    (tmp_path / "a.task.toml").write_text('like = "a"')
    with pytest.raises(UnknownTask, match="like itself"):
        read_task(tmp_path / "a.task.toml")


def test_a_robot_that_stops_by_feedback_brakes_by_what_is_measured():
    description = changed("input", "speed", "stop", {"speed": -1.0})
    description["stopped"] = 0.05
    del description["input"]["speed"]["slew"]
    robot: Robot = robot_from_description(description)
    state = np.array([9.0, 9.0, 1.0, 0.3, 0.1])
    assert robot.stop_by_feedback(np.array([0.0, 0.2]), state, np.zeros(2)) == pytest.approx([-0.3, 0.2])
    assert robot.stop_by_feedback(np.zeros(2), np.array([0, 0, 0, 9.0, 0]), np.zeros(2))[0] == -0.5, "within bounds"
    assert not robot.is_standing(state) and robot.is_standing(np.array([9.0, 9.0, 1.0, 0.04, 0.0]))
    with pytest.raises(UnknownRobot, match="no real-time mode"):
        robot.in_real_time()


def test_a_ramp_goes_down_step_by_step():
    robot = replace(GROUND, horizon=6, free_steps=2, brake_steps=4)
    plan = (robot.plan_matrix() @ [0.1, 0.2, 0.2, 0.4]).reshape(6, 2)
    assert np.allclose(plan[:, 0], [0.1, 0.2, 0.15, 0.1, 0.05, 0.0])
    assert np.allclose(plan[:, 1], [0.2, 0.4, 0.3, 0.2, 0.1, 0.0])


def test_the_layout_changes_with_whatever_two_processes_must_share():
    assert GROUND.layout() == replace(GROUND).layout()
    assert GROUND.layout() != replace(GROUND, body=(Disc((0.0, 0.0), 0.1),)).layout()
    assert GROUND.layout() != replace(GROUND, action_high=(0.25, 0.6)).layout()
