"""Which robot a message of a log names: one that the log describes, or one of the program."""

import json
from dataclasses import replace

import pytest

from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.messaging.robot import robot_named
from brakeline.messaging.task import RobotWithTask


def test_a_robot_of_one_log_is_unknown_in_another():
    minted = replace(robot_named("ground"), name="minted")
    one, other = RecordedRobots(), RecordedRobots()
    one.describe({"minted": json.dumps(minted.description)})
    assert one.named("minted") == minted and one.named("minted-late") == minted.in_real_time()
    assert other.named("minted") is None


def test_robots_that_come_with_the_program_have_their_tasks():
    robot = RecordedRobots().named("quadrotor-late")
    assert isinstance(robot, RobotWithTask) and robot.late and robot.task.observation_dim == 189


def test_a_description_that_takes_a_shipped_name_is_not_believed(caplog: pytest.LogCaptureFixture):
    robots = RecordedRobots()
    robots.describe({"ground": json.dumps(replace(robot_named("ground"), sight=0.1).description), "broken": "{"})
    assert robots.named("ground").sight == robot_named("ground").sight and robots.named("broken") is None
    assert "choose another" in caplog.text and len(caplog.records) == 2


def test_a_robot_name_in_a_message_is_never_a_path(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text("")
    assert RecordedRobots().named(str(path)) is None and RecordedRobots().named("../robots/ground") is None
