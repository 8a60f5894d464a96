"""examples/own_log: from minutes of driving to a filter. The table that it prints is in docs/own_log.md."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from brakeline.deploy import cli
from brakeline.messaging.robot import robot_named
from tests.examples.programs import EXAMPLES, run_program

ROBOTS = ("diff", "skid", "car", "boat")


@pytest.mark.fast
@pytest.mark.parametrize("name", ROBOTS)
def test_a_drive_fits_its_description(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["drive.py", name, "--minutes", "0.5", "--seed", "3"])
    runpy.run_path(str(EXAMPLES / "own_log" / "drive.py"), run_name="__main__")
    header, *rows = capsys.readouterr().out.splitlines()
    robot = robot_named(str(EXAMPLES / "own_log" / f"{name}.toml"))
    labels = [label.rpartition(" [")[0] for label in (*robot.state, *robot.action)]
    assert header.split(",") == ["time", "run", *labels]
    assert len(rows) == 600
    inputs = np.array([row.split(",")[-2:] for row in rows], float)
    assert (inputs >= robot.low()).all() and (inputs <= robot.high()).all()


def test_four_minutes_give_a_filter(tmp_path):
    figures = tmp_path / "figures.json"
    output = run_program("own_log/table.py", "--robots", "diff", "--minutes", "4", "--quick", "--json", str(figures))
    (row,) = json.loads(figures.read_text())
    assert output.count("\n") == 3 and output.splitlines()[2].startswith("| diff | 4 min |")
    assert row["clearance"] < 0.05 and row["straight"]["set"] < 0.02
    assert row["fresh"]["outside"] <= row["bound"] and row["fresh"]["plans"] > 1000
    for driver, episodes in (("adversary", 20), ("planner", 10)):
        assert row[driver]["episodes"] == episodes and row[driver]["collisions"] == 0
    assert 0.0 < row["adversary"]["nearest"] < 0.06 and row["adversary"]["decisions"]["adjusted"] > 0.5
    assert row["planner"]["goals"] >= 9


def test_the_model_set_of_a_log_simulates_the_robot_and_the_robot_itself_judges_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    skid, log = str(EXAMPLES / "own_log" / "skid.toml"), tmp_path / "skid.csv"
    Path(log).write_text(run_program("own_log/drive.py", "skid", "--minutes", "4", "--seed", "1"))
    assert cli.main(["import", str(log), "--robot", skid, "-q"]) == 0
    assert cli.main(["certify", skid, "--use", "-q"]) == 0
    capsys.readouterr()
    for learned in ((), ("--learned",)):
        assert cli.main(["evaluate", skid, *learned, "--policy", "astar", "--episodes", "3", "--json"]) == 0
        figures = json.loads(capsys.readouterr().out)
        assert (figures["episodes"], figures["goals"], figures["collisions"]) == (3, 3, 0)
        assert figures["containment"]["violations"] == 0 < figures["containment"]["steps"]
        assert figures["conditions"].get("learned") == ("True" if learned else None)
