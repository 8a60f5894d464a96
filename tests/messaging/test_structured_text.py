"""JSON and TOML that are damaged or nested too deeply are an error of ours, wherever a file is read."""

import json
from pathlib import Path

import pytest

from brakeline.deploy.run.processes import client_settings
from brakeline.errors import BadText, BadWeights, BrakelineError, UnknownRobot, UnknownTask
from brakeline.logs.recorded_robots import RecordedRobots
from brakeline.messaging.policy_weights import decode
from brakeline.messaging.robot_description import read_robot
from brakeline.messaging.structured_text import parse_json, parse_toml
from brakeline.messaging.task import read_task

JSON, TOML = '{"a":' * 100_000, "a = " + "[" * 100_000


def test_what_is_nested_too_deeply_is_an_error_of_ours() -> None:
    for text in (JSON, "{", "\ud800", ""):
        with pytest.raises(BadText, match="not JSON"):
            parse_json(text)
    with pytest.raises(BadText, match="not JSON"):
        parse_json(b"\xff\xfe\xfd")
    for text in (TOML, "a = ", "[a\n"):
        with pytest.raises(BadText, match="not TOML"):
            parse_toml(text)
    assert issubclass(BadText, BrakelineError) and issubclass(BadText, ValueError)


def test_so_is_a_file_of_a_robot_a_task_a_policy_and_a_run(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(TOML)
    with pytest.raises(UnknownRobot, match=r"robot\.toml"):
        read_robot(tmp_path / "robot.toml")
    (tmp_path / "robot.task.toml").write_text(TOML)
    with pytest.raises(UnknownTask, match=r"robot\.task\.toml"):
        read_task(tmp_path / "robot.task.toml")
    header = json.dumps({"__metadata__": {"policy": JSON}}).encode()
    with pytest.raises(BadWeights):
        decode(len(header).to_bytes(8, "little") + header)
    (tmp_path / "endpoint").write_text(JSON)
    with pytest.raises(BadText):
        client_settings(tmp_path)
    RecordedRobots().describe({"deep": JSON})  # skips it, with a warning
