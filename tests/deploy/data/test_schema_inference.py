"""A description's first draft is what a log tells, and says of the rest that it does not."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from brakeline.deploy.cli import main
from brakeline.deploy.data.importer import import_sources, tables_of
from brakeline.deploy.data.schema_inference import InferredColumn, brake_periods, infer_schema
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import NoSource
from brakeline.messaging.robot import robot_named
from brakeline.messaging.robot_files import ROBOTS_FOLDER as ROBOTS
from tests.deploy.data.bags import write_bag
from tests.deploy.data.porter import COLUMNS, drive, write_csv

pytestmark = pytest.mark.usefixtures("reading_here")


@pytest.fixture(scope="module")
def driven():
    return drive(seconds=120.0)


def table(time, values, names=COLUMNS) -> Table:
    return Table("", np.asarray(time), dict(zip(names, values.T, strict=True)))


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_a_drafted_description_is_checked_and_reads_the_log_it_was_made_from(driven, tmp_path, capsys, figures, kind):
    write = {"csv": write_csv, "bag": write_bag}[kind]
    log, path = write(tmp_path / {"csv": "drive.csv", "bag": "drive"}[kind], *driven), tmp_path / f"drafted-{kind}.toml"
    assert main(["robot", "new", str(path), "--from", str(log)]) == 0
    text = path.read_text()
    assert "# The body cannot be inferred from the log: measure it." in text and "# error: cannot be inferred" in text
    assert "# with the delays in the log, without lags" in text
    path.write_text(text.replace("radius = 0.2", "radius = 0.15").replace("sight = 3.0", "sight = 2.5"))
    capsys.readouterr()
    assert figures("robot", "check", path)["problems"] == []
    robot = robot_named(str(path))
    speeds = ("v [m/s]", "w [rad/s]") if kind == "csv" else ("speed [m/s]", "turn rate [rad/s]")
    assert robot.state == ("x [m]", "y [m]", "heading [rad]", *speeds) and robot.heading == 2
    assert robot.action == ("speed [m/s]", "turn rate [rad/s]") and robot.follows == (3, 4)
    assert robot.period == pytest.approx(0.1) and robot.brake_steps == 3
    assert robot.action_low == (0.0, -1.5) and robot.action_high == (0.6, 1.5)
    assert len(import_sources([log], robot).data.trajectories) > 5


@pytest.mark.parametrize("absurd", [1e17, 1e30, 1e300])
def test_an_absurd_stamp_costs_only_its_row(driven, absurd):
    """It made the stamps of the next run equal: their differences were too small beside it."""
    time, values = driven[0].copy(), driven[1]
    half = len(time) // 2
    time[half] = absurd
    runs = np.repeat([0, 1], [half + 1, len(time) - half - 1])
    given = Table("", time, dict(zip(COLUMNS, values.T, strict=True)), runs)
    schema, whole = infer_schema([given]), infer_schema([table(*driven)])
    assert schema.period == pytest.approx(whole.period) and schema.states == whole.states


def test_what_is_what_is_seen_by_the_motion_whatever_the_names(driven):
    time, values = driven
    names = ("x", "y", "a", "b", "c", "d", "e")
    schema = infer_schema([table(time, values, names)])
    assert [(c.name, c.role, c.unit, c.follows) for c in schema.states[2:]] == [
        ("a", "heading", "rad", ""),
        ("b", "other", "m/s", "d"),
        ("c", "other", "rad/s", "e"),
    ]
    assert [(c.name, c.unit) for c in schema.inputs] == [("d", "m/s"), ("e", "rad/s")]
    shuffled = np.random.default_rng(0).permuted(values[:, 2])
    schema = infer_schema([table(time, np.column_stack([values[:, :2], shuffled, values[:, 3:]]), names)])
    assert all(c.role != "heading" for c in schema.states)
    assert any("no column is clearly the heading" in note for note in schema.notes)


def test_a_delay_is_told_and_makes_the_plan_longer(driven, tmp_path):
    time, values = driven
    late = np.column_stack([values[:-10, :5], values[10:, 5:]])  # states of 0.2 s before
    prompt, delayed = infer_schema([table(time, values)]), infer_schema([table(time[: len(late)], late)])
    for before, after in zip(prompt.states[3:], delayed.states[3:], strict=True):
        assert after.delay == pytest.approx(before.delay + 0.2, abs=0.03)
    paths = [write_csv(tmp_path / "a.csv", time, values), write_csv(tmp_path / "b.csv", time[: len(late)], late)]
    horizons = []
    for path in paths:
        assert main(["robot", "new", str(path.with_suffix(".toml")), "--from", str(path)]) == 0
        horizons.append(robot_named(str(path.with_suffix(".toml"))).horizon)
    assert horizons[1] == horizons[0] + 2
    for state in delayed.states[3:]:  # a delay counts by the period
        assert f"{1e3 * state.delay:.0f} ms after its input: {state.delay / delayed.period:.1f} periods" in (
            paths[1].with_suffix(".toml").read_text()
        )


def test_a_new_description_says_what_to_do_about_a_delay_above_one_period(driven, tmp_path, capsys):
    """Otherwise `certify`, minutes later, says that the sets are wide."""
    for rows, said in ((0, False), (12, True)):  # a joystick of 0.1 s, and a robot that is another 0.24 s late
        values = driven[1].copy()
        values[rows:, :5] = driven[1][: len(values) - rows, :5]
        path, robot = write_csv(tmp_path / f"drive{rows}.csv", driven[0], values), tmp_path / f"my{rows}.toml"
        assert main(["robot", "new", str(robot), "--from", str(path)]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert ("predictions use one earlier input only" in text) == said, text
        assert ("The file then has `period = 0.3`" in text or "The file then has `period = 0.4`" in text) == said, text


def test_a_delay_of_one_period_is_one_period_but_for_rounding():
    follower = InferredColumn("v", "m/s", 0.0, 1.0, follows="speed", delay=math.nextafter(0.1, 1.0))
    assert brake_periods(0.1, [follower], []) == (1, 1)


def test_an_input_of_the_same_name_a_slew_and_one_that_only_turns(tmp_path):
    """Each speed by itself: `speed` is the coordinate, `command speed` the input; the speed changes by 0.05 at most."""
    step, rows, pose, speed = 0.1, [], np.zeros(3), 0.0
    rng = np.random.default_rng(1)
    for k in range(1200):
        target, turn = ((0.4, 0.0), (0.0, 0.0), (0.0, 0.8), (0.0, -0.8))[k // 25 % 4]
        speed += float(np.clip(target - speed, -0.05, 0.05))
        noise = rng.uniform(-0.003, 0.003, 5)
        rows.append([*(np.array([*pose, speed, turn]) + noise), speed, turn])
        pose += step * np.array([speed * math.cos(pose[2]), speed * math.sin(pose[2]), turn])
    names = ("x", "y", "yaw", "speed", "turn", "command speed", "command turn")
    schema = infer_schema(tables_of(write_csv(tmp_path / "a.csv", step * np.arange(1200), np.array(rows), names)))
    ahead, turning = schema.inputs
    assert (ahead.name, turning.name) == ("speed", "turn")
    assert [column.follows for column in schema.states[3:]] == ["speed", "turn"]
    assert ahead.change == pytest.approx(0.05) and (ahead.moves, turning.moves) == (True, False)


def steering_log(path, header):
    """Write the log of a robot with a steered wheel that somebody drives, in degrees."""
    rng, rows, (x, y, heading, v, angle), given = np.random.default_rng(3), [], np.zeros(5), np.zeros(2)
    for k in range(1500):
        if k % 2 == 0 and rng.random() < 0.2:
            given = np.round(rng.uniform([0.0, -40.0], [0.8, 40.0]), 1) * (rng.random() > 0.2)
        rows.append([0.1 * k, x, y, math.degrees(heading), v, angle, *given])
        v, angle = v + 0.4 * (given[0] - v), angle + 0.4 * (given[1] - angle)
        x, y = x + 0.1 * v * math.cos(heading), y + 0.1 * v * math.sin(heading)
        heading += 0.1 * v * math.tan(math.radians(angle)) / 0.4
    text = "\n".join(",".join(f"{value:.5g}" for value in row) for row in rows)
    path.write_text(f"time,x,y,yaw [deg],v,{header}\n{text}\n")
    return path


def test_the_unit_in_a_header_is_the_unit_of_the_description(tmp_path, capsys):
    log = steering_log(tmp_path / "drive.csv", "wheel [deg],cmd_v,cmd_wheel [deg]")
    assert main(["robot", "new", str(tmp_path / "my.toml"), "--from", str(log)]) == 0
    robot = robot_named(str(tmp_path / "my.toml"))
    assert "wheel [rad]" in robot.state and "cmd_wheel [rad]" in robot.action
    drafted = tomllib.loads((tmp_path / "my.toml").read_text())
    assert drafted["input"]["cmd_wheel"]["stop"] == "hold"  # as a car holds its steering


def test_an_input_without_a_unit_names_the_entries_of_a_steering_angle(tmp_path, capsys):
    log = steering_log(tmp_path / "drive.csv", "wheel,cmd_v,cmd_wheel")
    assert main(["robot", "new", str(tmp_path / "my.toml"), "--from", str(log)]) == 0
    line = next(text for text in (tmp_path / "my.toml").read_text().splitlines() if text.startswith("cmd_wheel"))
    assert 'unit = "1"' in line and 'a steering angle has unit = "rad" and stop = "hold"' in line.partition("#")[2]


def test_an_input_in_another_unit_than_its_speed_is_noted(tmp_path, driven, capsys):
    time, values = driven[0], driven[1].copy()
    values[:, 6] = np.degrees(values[:, 6]) * 1.2  # the robot turns more slowly than it is told to
    log = write_csv(tmp_path / "drive.csv", time, values, columns=(*COLUMNS[:5], "cmd_v", "cmd_w"))
    assert main(["robot", "new", str(tmp_path / "my.toml"), "--from", str(log)]) == 0
    assert "cmd_w may be in deg/s: it is" in " ".join(capsys.readouterr().out.split())
    log = write_csv(tmp_path / "drive.csv", *driven, columns=(*COLUMNS[:5], "cmd_v", "cmd_w"))
    assert main(["robot", "new", str(tmp_path / "other.toml"), "--from", str(log)]) == 0
    assert "may be in" not in capsys.readouterr().out


def test_without_positions_or_inputs_it_says_what_is_missing(driven, tmp_path, capsys):
    time, values = driven
    with pytest.raises(NoSource, match="the position columns `x` and `y` are missing; the columns are: a, b"):
        infer_schema([table(time, values[:, :2], ("a", "b"))])
    with pytest.raises(NoSource, match="the command then reads no others: --map x=COLUMN y=COLUMN heading=COLUMN"):
        infer_schema([table(time, values[:, :2], ("a", "b"))])
    path = write_csv(tmp_path / "a.csv", time, values[:, :5], COLUMNS[:5])
    out = tmp_path / "seen.toml"
    assert main(["robot", "new", str(out), "--from", str(path), "--map", "x=x", "y=y"]) == 1
    assert "left out, as --map does not name them: heading, v, w" in " ".join(capsys.readouterr().err.split())
    assert main(["robot", "new", str(out), "--from", str(path)]) == 0
    text = out.read_text()
    assert "# no column is clearly an input" in text and "# Inputs cannot be inferred from the log" in text


@pytest.mark.parametrize("name", ["copter.bin", "copter.tlog", "px4.ulg"])
def test_a_flight_drafts_what_flies(tmp_path, capsys, name):
    """The description is right as it stands, reads the log that it was made from, and is the quadrotor's in kind."""
    log, path = Path(__file__).parent / "flown" / name, tmp_path / "flier.toml"
    assert main(["robot", "new", str(path), "--from", str(log)]) == 0
    assert main(["robot", "check", str(path)]) == 0, capsys.readouterr().err
    robot, known = robot_named(str(path)), robot_named("quadrotor")
    assert robot.state == known.state and robot.follows == known.follows and robot.body[0].at == known.body[0].at
    assert robot.action == ("vx [m/s]", "vy [m/s]", "vz [m/s]") and robot.period == pytest.approx(0.2, abs=0.005)
    assert len(import_sources([log], robot).data.trajectories) > 0


def log_of(path, *robots):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="brakeline")
        writer.add_metadata("robots", {robot.name: json.dumps(robot.description) for robot in robots})
        writer.finish()
    return path


@pytest.mark.parametrize("name", ["quadrotor", str(ROBOTS / "../examples/car/car.toml")])
def test_a_log_of_a_run_carries_the_description(tmp_path, name):
    robot = robot_named(name)
    log, path = log_of(tmp_path / "run.mcap", robot), tmp_path / "found.toml"
    assert main(["robot", "new", str(path), "--from", str(log)]) == 0
    assert robot_named(str(path)).description == robot.description | {"name": "found"}


def test_of_several_robots_in_a_log_the_files_name_chooses(tmp_path, capsys):
    log = log_of(tmp_path / "run.mcap", robot_named("ground"), robot_named("quadrotor"))
    assert main(["robot", "new", str(tmp_path / "mine.toml"), "--from", str(log)]) == 1
    assert "holds the robots ground, quadrotor: name the file after" in " ".join(capsys.readouterr().err.split())
    assert main(["robot", "new", str(tmp_path / "quadrotor.toml"), "--from", str(log)]) == 0
    assert "horizon = 12" in (tmp_path / "quadrotor.toml").read_text()


def test_a_steering_that_a_robot_holds_while_braking_does_not_make_braking_longer():
    speed = InferredColumn("v", "m/s", 0.0, 0.8, follows="cmd_v", change=0.2)
    wheel = InferredColumn("wheel", "rad", -0.9, 0.9, follows="cmd_wheel", change=0.1)
    inputs = InferredColumn("cmd_v", "m/s", 0.0, 0.8), InferredColumn("cmd_wheel", "rad", -0.9, 0.9, change=0.1)
    assert brake_periods(0.1, [speed, wheel], inputs)[0] == 4


@pytest.mark.parametrize("most", [np.inf, 1e308])
def test_a_value_that_falls_forever_needs_endless_periods_to_stop(most: float) -> None:
    column = InferredColumn("v", "m/s", -1.0, most, change=1e-9)
    assert brake_periods(0.1, [], [column])[0] >= 1_000_000
