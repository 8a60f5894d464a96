"""Test `brakeline robot`: a new description, a check, a look."""

import json

import pytest

from brakeline.deploy import cli


def run(capsys, *words):
    code = cli.main(["robot", *map(str, words)])
    return code, capsys.readouterr()


def test_a_new_description_has_no_mistake(tmp_path, capsys):
    path = tmp_path / "rover.toml"
    code, output = run(capsys, "new", path)
    assert code == 0 and f"robot check {path}" in output.out.replace("\n", "")
    assert 'name = "rover"' in path.read_text()
    code, output = run(capsys, "check", path)
    assert code == 0 and "no mistake" in output.out
    code, output = run(capsys, "new", path)
    assert code == 1 and "exists" in output.err


def test_check_lists_every_mistake_and_fails(tmp_path, capsys):
    path = tmp_path / "rover.toml"
    run(capsys, "new", path)
    path.write_text(path.read_text().replace("brake = 3", "brakes = 3").replace('"m/s"', '"km/h"', 1))
    code, output = run(capsys, "check", path)
    assert code == 1
    assert "plan.brakes: unknown; did you mean 'brake'?" in output.err and "state.speed.unit" in output.err
    code, output = run(capsys, "check", path, "--json")
    assert code == 1 and {"plan.brakes", "plan.brake", "state.speed.unit"} <= {
        f for f, _ in json.loads(output.out)["problems"]
    }


def test_check_remarks_on_a_short_sensor_range(tmp_path, capsys):
    path = tmp_path / "rover.toml"
    run(capsys, "new", path)
    path.write_text(path.read_text().replace("sight = 3.0", "sight = 0.2"))
    _, output = run(capsys, "check", path, "--json")
    assert any(remark.startswith("sight") for remark in json.loads(output.out)["remarks"])


@pytest.mark.parametrize("robot", ["ground", "quadrotor"])
def test_show_prints_and_draws_a_description(tmp_path, capsys, robot):
    picture = tmp_path / "robot.png"
    code, output = run(capsys, "show", robot, "--picture", picture, "--json")
    shown = json.loads(output.out)
    assert code == 0 and picture.read_bytes().startswith(b"\x89PNG")
    assert shown["name"] == robot and shown["footprint_m"] in (0.105, 0.3)
    code, output = run(capsys, "show", robot)
    assert "[m/s]" in output.out and "layout" in output.out
