"""Files of columns as other people write them: one drive in any dialect, unit and kind of stamps is one data set."""

import io
import math
import os
import re
import shlex
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from brakeline.deploy import progress
from brakeline.deploy.cli import main
from brakeline.deploy.data.sources.csv_file import read
from brakeline.messaging.robot import robot_named
from brakeline.safety.model.dataset import Dataset
from tests.deploy.data.porter import COLUMNS, FILE, STEP, Porter, drive, driven_by, write_csv
from tests.deploy.data.test_importer import same

pytestmark = pytest.mark.usefixtures("reading_here")
EPOCH = 1_760_000_000
STAMPS = {
    "time": lambda t: f"{t:.2f}",
    "timestamp": lambda t: f"{t:.2f}",
    "time [min]": lambda t: f"{t / 60.0:.12f}",
    "time [h]": lambda t: f"{t / 3600.0:.12f}",
    "t [ms]": lambda t: f"{1e3 * t:.0f}",
    "time_us": lambda t: f"{1e6 * t:.0f}",
    "Time": lambda t: f"{EPOCH + t:.2f}",
    "stamp": lambda t: f"{1000 * EPOCH + round(1e3 * t)}",
    "%time": lambda t: f"{1_000_000_000 * EPOCH + round(1e9 * t)}",
    "datetime": lambda t: datetime.fromtimestamp(EPOCH + round(t, 2), UTC).isoformat(timespec="milliseconds"),
}
UNITS = {"heading": ("deg", math.radians(1.0)), "v": ("km/h", 1 / 3.6), "speed": ("mm/s", 1e-3), "x": ("cm", 0.01)}


@pytest.fixture(scope="module")
def driven():
    return drive(seconds=60.0)


@pytest.fixture(scope="module")
def plain(driven, tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    return imported(write_csv(folder / "drive.csv", *driven))


def imported(path, *words) -> Dataset:
    out = path.with_suffix(".safetensors")
    assert main(["import", str(path), "--robot", str(FILE), "--out", str(out), *words]) == 0
    return Dataset.load(out)


def write_cells(path, names, rows):
    """Write a CSV file. rows: of text, or of numbers, which keep all their digits."""
    cells = [[cell if isinstance(cell, str) else repr(float(cell)) for cell in row] for row in rows]
    path.write_text("\n".join(map(",".join, [names, *cells])) + "\n")
    return path


def exported(driven, names, fields):
    """Write a drive as exported messages do: the names and rows of stamps in ns, a text, and the fields of a row.

    fields: from a row of the drive, with the heading as a quaternion, to the cells.
    """
    rows = []
    for t, (x, y, heading, *others) in zip(*driven, strict=True):
        turned = (0.0, 0.0, math.sin(heading / 2.0), math.cos(heading / 2.0))
        rows.append([f"{EPOCH * 10**9 + round(1e9 * t)}", "odom", *fields(t, (x, y), turned, others)])
    return ["%time", "field.header.frame_id", *names], rows


@st.composite
def ways(draw):
    """How to write the drive: (text, encoding, options of the import), as a function of the drive."""
    separator = draw(st.sampled_from([",", ";", "\t", "|", ", ", " "]))
    decimal = draw(st.sampled_from(".," if separator in (";", "\t", "|") else "."))
    stamp = draw(st.sampled_from([name for name in STAMPS if separator != " " or " " not in name]))
    end = draw(st.sampled_from(["\n", "\r\n"]))
    encoding = draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]))
    header = draw(st.sampled_from(["plain", "commented", "after comments", "quoted"]))
    last = draw(st.sampled_from(["whole", "half written", "without end"]))
    units = draw(st.sets(st.sampled_from(sorted(UNITS))))
    named_in = draw(st.sampled_from(["header", "option"])) if separator != " " else "option"
    order = draw(st.permutations(range(len(COLUMNS))))

    def write(time, values):
        values, names, words = values.copy(), list(COLUMNS), []
        for name in sorted(units):
            unit, scale = UNITS[name]
            values[:, COLUMNS.index(name)] /= scale
            if named_in == "header":
                names[COLUMNS.index(name)] = f"{name} [{unit}]"
            else:
                words += ["--unit"] * (not words) + [f"{name}={unit}"]
        if separator == " ":
            names = [name.replace(" ", "_") for name in names]
        names = [stamp, *(names[i] for i in order)]
        names = [f'"{name}"' for name in names] if header == "quoted" else names
        rows = [[STAMPS[stamp](t), *(repr(float(row[i])) for i in order)] for t, row in zip(time, values, strict=True)]
        lines = [separator.join(cell.replace(".", decimal) if decimal == "," else cell for cell in row) for row in rows]
        first = ("# " if header == "commented" else "") + separator.join(names)
        comments = ["# logger v2", "# robot: porter, run 3"] if header == "after comments" else []
        text = end.join([*comments, first, *lines]) + end
        text += {"whole": "", "half written": lines[-1][: len(lines[-1]) // 2], "without end": lines[-1]}[last]
        return text, encoding, words

    return write


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(way=ways())
def test_one_drive_in_any_dialect_unit_and_stamps_is_one_data_set(way, driven, plain, tmp_path_factory):
    text, encoding, words = way(*driven)
    path = tmp_path_factory.mktemp("way") / "drive.csv"
    path.write_bytes(text.encode(encoding))
    same(plain, imported(path, *words), 1e-5)


# --- units that the motion contradicts ----------------------------------------------------------------------------


def refused(capsys, words):
    assert main([str(word) for word in words]) == 1
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("columns", "factor", "said"),
    [
        (["heading"], 180 / math.pi, "heading looks like degrees"),
        (["v"], 3.6, "v looks like km/h: it is 3.6"),
        (["v", "speed"], 1000.0, "--unit v=mm/s"),
        (["w"], 180 / math.pi, "w looks like deg/s"),
        (["x", "y"], 1000.0, "x, y look like mm"),
    ],
)
def test_units_that_the_motion_contradicts_are_refused(driven, tmp_path, capsys, columns, factor, said):
    time, values = driven
    values = values.copy()
    for name in columns:
        values[:, COLUMNS.index(name)] *= factor
    path = write_csv(tmp_path / "drive.csv", time, values)
    out = tmp_path / "none.safetensors"
    text = refused(capsys, ["import", path, "--robot", FILE, "--out", out])
    assert said in text and "--unit" in text and not out.exists()
    if columns != ["x", "y"]:  # a description has metres; only a known speed shows that they are none
        text = refused(capsys, ["robot", "new", tmp_path / "my.toml", "--from", path])
        assert said in text and not (tmp_path / "my.toml").exists()


def test_a_compass_heading_is_named_and_converted(driven, plain, tmp_path, capsys):
    time, values = driven
    values = values.copy()
    values[:, 2] = (90.0 - np.degrees(values[:, 2])) % 360.0
    path = write_csv(tmp_path / "drive.csv", time, values)
    text = refused(capsys, ["import", path, "--robot", FILE, "--out", tmp_path / "a.safetensors"])
    assert "heading looks like a compass heading" in text and "--unit heading=compass" in text
    same(plain, imported(path, "--unit", "heading=compass"), 1e-5)


@pytest.mark.parametrize("word", ["heading=deg", "heading=compass", "v=km/h", "speed=mm/s", "w=deg/s"])
def test_a_conversion_of_a_column_in_si_units_is_refused(driven, tmp_path, capsys, word):
    path, out = write_csv(tmp_path / "drive.csv", *driven), tmp_path / "none.safetensors"
    text = refused(capsys, ["import", path, "--robot", FILE, "--out", out, "--unit", word])
    assert f"already: only without --unit {word} does the motion agree" in text and not out.exists()
    mine = tmp_path / "my.toml"
    text = refused(capsys, ["robot", "new", mine, "--from", path, "--unit", word])
    assert f"already: only without --unit {word} does the motion agree" in text and not mine.exists()


@pytest.mark.parametrize("stamp", ["", "nan", "inf", "-inf"])
def test_a_row_without_a_stamp_is_left_out(driven, plain, tmp_path, stamp):
    path = write_csv(tmp_path / "drive.csv", *driven)
    header, *rows = path.read_text().splitlines()
    rows[503] = stamp + rows[503][rows[503].index(",") :]  # within a period, and one of ten rows
    path.write_text("\n".join([header, *rows]) + "\n")
    data = imported(path)
    assert data.periods == plain.periods
    assert np.allclose(data.trajectories[1].states, plain.trajectories[1].states)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
def test_a_degree_sign_is_one_in_any_encoding(driven, plain, tmp_path, encoding):
    time, values = driven[0], driven[1].copy()
    values[:, 2], values[:, 4] = np.degrees(values[:, 2]), np.degrees(values[:, 4])
    names = [{"heading": "heading (°)", "w": "w [°/s]"}.get(name, name) for name in COLUMNS]
    path = write_csv(tmp_path / "drive.csv", time, values, names)
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    same(imported(path), plain, 1e-8)


@pytest.mark.parametrize("command", ["import", "collect"])
def test_a_file_that_is_no_data_set_is_not_written_over(driven, tmp_path, capsys, command):
    """Least of all the log itself. A data set may be written again."""
    path = write_csv(tmp_path / "drive.csv", *driven)
    imported(path)
    before, words = path.read_text(), ["import", path, "--robot", FILE] if command == "import" else ["collect"]
    assert "exists, and is no data set: choose another file" in refused(capsys, [*words, "--out", path])
    assert path.read_text() == before
    imported(path)


@pytest.mark.parametrize("out", [True, False])
def test_the_next_command_names_the_data_set_where_it_is_not_the_one_in_use(driven, tmp_path, capsys, monkeypatch, out):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    path = write_csv(tmp_path / "drive.csv", *driven)
    chosen = ["--out", str(tmp_path / "my.safetensors")] if out else []
    assert main(["import", str(path), "--robot", str(FILE), *chosen]) == 0
    line = "".join(capsys.readouterr().out.split("next:")[1].split())
    assert line.startswith("brakelinecertify") and line.endswith("--use") and ("--data" in line) == out


def test_the_unit_1_takes_a_column_as_it_is(driven, plain, tmp_path):
    path = write_csv(tmp_path / "drive.csv", *driven)
    same(plain, imported(path, "--unit", "heading=1", "v=1"), 1e-12)


def test_a_header_names_the_unit_of_a_column_beside_one_of_the_same_name(driven, plain, tmp_path):
    """`speed` in m/s and `speed [km/h]`: whoever maps the second one gets m/s, and need not give --unit."""
    time, values = driven
    more, names = np.column_stack([values, 3.6 * values[:, 5]]), (*COLUMNS, "speed [km/h]")
    path, file = write_csv(tmp_path / "drive.csv", time, more, names), tmp_path / "new.toml"
    for unit in ([], ["--unit", "speed=km/h"]):
        same(imported(path, "--map", "speed=speed [km/h]", *unit), plain, 1e-8)
    places = [f"{name}={name}" for name in ("x", "y", "heading", "v", "w")]
    main(["robot", "new", str(file), "--from", str(path), "--map", *places, "command speed=speed [km/h]"])
    assert tomllib.loads(file.read_text())["input"]["command speed"]["high"] == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize("unit", ["deg", "rad", "1"])
def test_a_unit_that_an_option_names_counts_instead_of_that_in_the_header(driven, plain, tmp_path, capsys, unit):
    """Before, both counted: positions in mm became a thousand times too small, and a wrong header stayed wrong."""
    time, values = driven[0], driven[1].copy()
    values[:, 2] = np.degrees(values[:, 2]) if unit == "deg" else values[:, 2]
    values[:, :2] *= 1000.0
    names = [{"x": "x [mm]", "y": "Y (mm)", "heading": "heading [deg]"}.get(name, name) for name in COLUMNS]
    path = write_csv(tmp_path / "drive.csv", time, values, names)
    units = ("--unit", "x=mm", "y=mm", f"heading={unit}")
    for places in ([], ["--map", "heading=heading [deg]", "y=Y (mm)"], ["--map", "y=Y"]):
        same(imported(path, *places, *units), plain, 1e-8)
    if unit == "deg":
        same(imported(path, "--map", "heading=heading [deg]"), plain, 1e-8)
        inputs = ("command speed=speed", "command turn=turn rate")
        words = ["--map", "x=x", "y=Y (mm)", "heading=heading [deg]", "v=v", "w=w", *inputs]
        assert main(["robot", "new", str(tmp_path / "mapped.toml"), "--from", str(path), *words]) == 0
        assert robot_named(str(tmp_path / "mapped.toml")).heading is not None
    text = refused(capsys, ["import", path, "--robot", FILE, *units, "--map", "v=v [mm/s]"])
    assert "there is no 'v [mm/s]' (--map)" in text, "no header names this unit"
    mine = tmp_path / "my.toml"
    assert main(["robot", "new", str(mine), "--from", str(path), "--unit", "x=mm", "Y=mm", f"heading={unit}"]) == 0
    assert robot_named(str(mine)).heading is not None and "turn rate [rad/s]" in robot_named(str(mine)).action


def test_a_unit_that_does_not_fit_is_refused(driven, tmp_path, capsys):
    path = write_csv(tmp_path / "drive.csv", *driven)
    for word, said in (("v=deg", "v is in m/s"), ("v=furlong", "UNIT is one of"), ("why=deg", "must be one of x, y")):
        assert said in refused(capsys, ["import", path, "--robot", FILE, "--unit", word])
    twice = {"--unit": ["v=km/h", "v=mph"], "--map": ["v=w", "v=speed"]}
    for option, words in twice.items():
        assert f"{option} names 'v' twice" in refused(capsys, ["import", path, "--robot", FILE, option, *words])


def test_a_unit_that_nobody_knows_is_refused_until_it_is_named(driven, tmp_path, capsys):
    time, values = driven
    names = ["speed [%]" if name == "speed" else name for name in COLUMNS]
    path = write_cells(tmp_path / "drive.csv", ("time", *names), np.column_stack([time, values]))
    text = refused(capsys, ["import", path, "--robot", FILE])
    assert "speed [%] is in no known unit; name it with --unit 'speed'=UNIT" in text
    imported(path, "--unit", "speed=m/s")
    imported(path, "--map", "speed=speed [%]")
    path = write_cells(tmp_path / "drive.csv", ("time [m]", *COLUMNS), np.column_stack([time, values]))
    assert "'m' is no known unit of time" in refused(capsys, ["import", path, "--robot", FILE])
    for name in ("time [-]", "time [0]"):  # no unit, and the index of a field
        imported(write_cells(tmp_path / "drive.csv", (name, *COLUMNS), np.column_stack([time, values])))
    imported(path, "--unit", "time=s")


def test_a_description_is_utf_8_in_any_locale(driven, tmp_path):
    """It holds the names of the log's columns."""
    path, new = write_csv(tmp_path / "log.csv", *driven), tmp_path / "new.toml"
    path.write_text(path.read_text().replace("heading", "heading [°]", 1), encoding="utf-8")
    words = (sys.executable, "-m", "brakeline.deploy.cli", "robot", "new", str(new), "--from", str(path))
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(words, env=os.environ | ascii_only, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "heading [°]" in new.read_text("utf-8") and robot_named(str(new)).heading is not None


def test_the_first_line_for_excel_is_passed_over(driven, plain, tmp_path):
    path = write_csv(tmp_path / "drive.csv", *driven)
    path.write_text("sep=,\n" + path.read_text())
    same(plain, imported(path), 1e-9)


def test_stamps_in_a_given_unit_that_the_motion_contradicts_are_refused(driven, tmp_path, capsys):
    time, values = driven
    path = write_csv(tmp_path / "drive.csv", 8.0 * time, values)  # a row every 0.16 s: plausible by itself
    text = refused(capsys, ["import", path, "--robot", FILE])
    assert "the time stamps do not fit" in text


@pytest.mark.parametrize("scale", [1e-6, 1e5])
def test_implausible_stamps_are_refused(driven, tmp_path, capsys, scale):
    time, values = driven
    path = write_cells(tmp_path / "drive.csv", ("time", *COLUMNS), np.column_stack([scale * time, values]))
    text = refused(capsys, ["robot", "new", tmp_path / "my.toml", "--from", path, "--unit", "time=s"])
    assert "not plausible" in text and "--unit time=ms" in text


# --- the period, bounds and choice of a description ---------------------------------------------------------------


def held():
    """120 s with somebody who holds the stick for a second at a time, commanded every 0.1 s."""
    rng = np.random.default_rng(0)
    inputs, u, left = [], np.zeros(2), 0
    for k in range(round(120.0 / STEP)):
        if k % 5 == 0:
            if left == 0:
                u, left = rng.choice([0.0, 0.3, 0.6], 2) * [1.0, rng.choice([-2.0, 2.0])], int(rng.integers(3, 21))
            left -= 1
        inputs.append(u)
    return driven_by(Porter(rng), inputs)


def described(path, *words, name="my"):
    toml = path.parent / f"{name}.toml"
    assert main(["robot", "new", str(toml), "--from", str(path), *map(str, words)]) == 0
    assert main(["robot", "check", str(toml)]) == 0
    return robot_named(str(toml)), toml.read_text()


def test_the_period_is_the_beat_of_a_stick_that_is_held(tmp_path, capsys):
    robot, text = described(write_csv(tmp_path / "held.csv", *held()))
    assert robot.period == pytest.approx(0.1)
    sure = re.search(r"(\d+)% of (\d+) times between two changes", text)
    assert sure and int(sure[1]) > 95 and int(sure[2]) > 30


def test_uneven_rows_show_the_beat_and_the_slew_of_a_controller(tmp_path, capsys):
    """Rows every 0.035 s, some late, of a stick that moves by 0.05 m/s and 0.2 rad/s at most, each 0.1 s."""
    rng = np.random.default_rng(1)
    robot, u, target, slew = Porter(rng), np.zeros(2), np.zeros(2), np.array([0.05, 0.2])
    times, values, due = [], [], 0.0
    for k in range(20_000):
        if k % 10 == 0:
            target = np.where(rng.random() < 0.05, rng.choice([0.0, 0.3, 0.6], 2) * [1.0, rng.choice([-2, 2])], target)
            u = u + np.clip(target - u, -slew, slew)
        if 0.01 * k >= due:
            times.append(0.01 * k + rng.uniform(0.0, 0.003))
            values.append([*robot.measured(), *u])
            due = 0.01 * k + rng.choice([0.03, 0.04], p=[0.55, 0.45]) + 0.01 * (rng.random() < 0.15)
        robot.step(u, 0.01)
    robot, _ = described(write_csv(tmp_path / "uneven.csv", np.array(times), np.array(values)))
    assert robot.period == pytest.approx(0.1, rel=5e-3)
    assert robot.slew == pytest.approx(slew, rel=1e-6)


def test_inputs_that_change_at_any_time_have_no_beat(tmp_path, capsys):
    time, values = held()
    rng = np.random.default_rng(2)
    moments = np.cumsum(rng.exponential(0.8, 400))
    values[:, 5:] = rng.choice([0.0, 0.3, 0.6], (401, 2))[np.searchsorted(moments, time)]
    robot, text = described(write_csv(tmp_path / "any.csv", time, values))
    assert robot.period == pytest.approx(0.1) and "a guess" in text


def test_glitches_are_named_and_cut(driven, tmp_path, capsys, figures):
    time, values = driven
    values = values.copy()
    for row, column, value in ((700, 5, 51.0), (701, 5, 51.0), (1500, 5, -40.0), (2000, 3, 900.0), (2500, 0, 77.0)):
        values[row, column] = value
    path = write_csv(tmp_path / "glitchy.csv", time, values)
    clean, _ = described(write_csv(tmp_path / "clean.csv", *driven), name="clean")
    robot, text = described(path)
    assert robot.action_high == clean.action_high and robot.brake_steps == clean.brake_steps
    assert "glitchy.csv, line 702, column speed: 51 is a glitch" in text
    assert "glitchy.csv, line 2002, column v: 900 is a glitch" in text and "line 2502, column x: 77" in text
    capsys.readouterr()
    notes = figures("import", path, "--robot", FILE, "--out", tmp_path / "a.safetensors")["report"]["notes"]
    assert any("line 2002, column v: 900 is a glitch" in note and "left out" in note for note in notes)
    assert any("line 702, column speed: 51 is a glitch" in note and "cut there" in note for note in notes)
    data = Dataset.load(tmp_path / "a.safetensors")
    assert max(np.abs(t.states[:, 3]).max() for t in data.trajectories) < 1.0


def test_columns_are_chosen_on_robot_new_and_import(driven, tmp_path, capsys):
    time, values = driven
    others = np.random.default_rng(0).normal(size=(len(time), 200))
    names = tuple(f"q{i}" for i in range(len(COLUMNS))) + tuple(f"sensor_{i}" for i in range(200))
    path = write_csv(tmp_path / "wide.csv", time, np.column_stack([values, others]), names)
    assert "--map x=COLUMN y=COLUMN" in refused(capsys, ["robot", "new", tmp_path / "no.toml", "--from", path])
    places = [f"{name}=q{i}" for i, name in enumerate(COLUMNS)]
    places[5:] = ["command v=q5", "command w=q6"]
    robot, _ = described(path, "--map", *places)
    assert robot.state == ("x [m]", "y [m]", "heading [rad]", "v [m/s]", "w [rad/s]")
    assert robot.action == ("v [m/s]", "w [rad/s]")
    said = " ".join(capsys.readouterr().out.split())
    assert "brakeline import" in said and "--map x=q0 y=q1 heading=q2 v=q3 w=q4 'command v=q5'" in said
    out = tmp_path / "a.safetensors"
    toml = str(tmp_path / "my.toml")
    assert main(["import", str(path), "--robot", toml, "--map", *places, "--out", str(out)]) == 0
    some = np.column_stack([values, others[:, :20]])
    narrow = write_csv(tmp_path / "narrow.csv", time, some, (*COLUMNS, *names[-20:]))
    robot, text = described(narrow, name="narrow")
    assert len(robot.state) == 5 and "left out, as the motion shows no role of them: sensor_180" in text


def test_a_command_that_is_printed_can_be_given_to_a_shell(driven, tmp_path, capsys):
    """Names with parentheses, and a path with spaces."""
    path, robot = tmp_path / "my drive.csv", tmp_path / "my.toml"
    time, values = driven
    write_csv(path, time, values, [{"x": "x(m)(raw)", "speed": "command speed"}.get(name, name) for name in COLUMNS])
    places = ["x=x(m)(raw)", *(f"{name}={name}" for name in ("y", "heading", "v", "w")), "command speed=command speed"]
    assert main(["robot", "new", str(robot), "--from", str(path), "--map", *places]) == 0
    said = " ".join(capsys.readouterr().out.split())
    words = shlex.split(re.search(r"`brakeline (import [^`]*)`", said)[1])
    assert main([*words, "--out", str(tmp_path / "a.safetensors")]) in (0, 1)
    assert words[1] == str(path) and words[words.index("--map") + 1 :] == places


def test_several_logs_describe_one_robot(tmp_path, capsys):
    fast, slow = drive(seconds=60.0), drive(seconds=60.0, seed=3)
    slow[1][:, 5] = np.minimum(slow[1][:, 5], 0.2)
    paths = [write_csv(tmp_path / "slow.csv", *slow), write_csv(tmp_path / "fast.csv", *fast)]
    toml = tmp_path / "both.toml"
    assert main(["robot", "new", str(toml), "--from", *map(str, paths)]) == 0
    assert robot_named(str(toml)).action_high == (0.6, 1.5) and "slow.csv, fast.csv" in toml.read_text()


def test_a_description_without_varying_inputs_passes_and_says_what_to_drive(driven, tmp_path, capsys):
    time, values = driven
    values = values.copy()
    values[:, 5:] = 0.0
    path = write_csv(tmp_path / "still.csv", time, values, (*COLUMNS[:5], "command v", "command w"))
    _, text = described(path)
    assert "record a drive with changing v and w" in text


# --- rows out of order, damage --------------------------------------------------------------------------------


def test_rows_out_of_order_are_sorted(driven, plain, tmp_path, capsys):
    time, values = driven
    order = np.arange(len(time))
    order[1000], order[1001] = 1001, 1000
    path = write_csv(tmp_path / "late.csv", time[order], values[order])
    same(plain, imported(path), 1e-9)
    assert "1 rows are out of order" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    "cells, numbers",
    [
        ({"t": ("999,5", "1.000,5"), "x": ("0,5", "-1,5")}, {"t": [999.5, 1000.5], "x": [0.5, -1.5]}),
        ({"t": ("1.234.567", "1.234.568"), "x": ("0,5", "1,5")}, {"t": [1234567.0, 1234568.0], "x": [0.5, 1.5]}),
        ({"t": ("1,000.5", "-2,000.25"), "x": ("0.5", "1.5")}, {"t": [1000.5, -2000.25], "x": [0.5, 1.5]}),
        ({"t": ("1 000,5", "1\u202f001,5"), "x": ("0,5", "1,5")}, {"t": [1000.5, 1001.5], "x": [0.5, 1.5]}),
        ({"t": ("1.000,5", "1.001,5"), "x": ("2.000,5", "3.000,5")}, {"t": [1000.5, 1001.5], "x": [2000.5, 3000.5]}),
        ({"t": ("0.999", "1.000"), "x": ("0,5", "1,5")}, {"t": [0.999, 1.0], "x": [0.5, 1.5]}),
        ({"t": ("0.999", "1.000"), "x": ("1.125", "2.125")}, {"t": [0.999, 1.0], "x": [1.125, 2.125]}),
        ({"t": ("999", "1.000"), "x": ("0,5", "1,5")}, {"x": [0.5, 1.5]}),  # nobody can tell
    ],
)
def test_marks_between_thousands(tmp_path, cells, numbers):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([";".join(cells), *map(";".join, zip(*cells.values(), strict=True))]) + "\n")
    (table,) = read(path)
    assert {name: list(values) for name, values in table.columns.items()} == numbers
    if numbers.keys() < cells.keys():
        (note,) = table.notes
        assert "column t, line 3: 1.000 has a mark between thousands, or" in note


def test_damaged_lines_and_cells_are_named(driven, plain, tmp_path, capsys):
    path = write_csv(tmp_path / "torn.csv", *driven)
    lines = path.read_text().splitlines(keepends=True)
    lines[500] = lines[500][:20] + "\n"
    lines[700] = re.sub(r",[^,]*,", ",###,", lines[700], count=1)
    path.write_text("".join(lines))
    imported(path)
    said = " ".join(capsys.readouterr().out.split())
    assert "torn.csv, line 501: not 8 cells, as the header has: left out" in said
    assert "torn.csv, column x, line 701: no number ('###'): the cell is left out" in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file has no rows"),
        ("time,x\n", "a header, but no whole row"),
        ("a,b\n1,2\n2,3\n", "no column is known to hold time stamps: name it with --map time=COLUMN"),
        ("0.0,1.0\n0.1,1.1\n0.2,1.2\n", "line 1: there is no header; the columns are column 1 to column 2"),
        ("time,x\n" + "1,2\n" * 30, "the time stamps never increase"),
        ("time,x,y\n" + "1,2\n" * 30, "line 2: 2 cells, but the header has 3 names"),
        ("time,x,x,y\n" + "".join(f"{i},1,2,3\n" for i in range(30)), "x (column 2), x (column 3)"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_cause(tmp_path, capsys, text, said):
    path = tmp_path / "odd.csv"
    path.write_text(text)
    assert said in refused(capsys, ["import", path, "--robot", FILE])
    assert said in refused(capsys, ["robot", "new", Path(tmp_path) / "my.toml", "--from", path])


def test_certify_shows_the_share_that_is_done_and_the_time_left(tmp_path, monkeypatch):
    path, out = tmp_path / "drive.safetensors", io.StringIO()
    imported(write_csv(tmp_path / "drive.csv", *drive(seconds=150.0))).save(path)
    monkeypatch.setattr(progress, "console", Console(file=out, force_terminal=True, width=100))
    main(["certify", str(FILE), "--data", str(path), "--few"])
    shown = [int(count) for count in re.findall(r"(\d+)/100", out.getvalue())]
    assert shown == sorted(shown) and len({*shown} - {0, 100}) >= 3, shown
    assert re.search(r"\d:\d\d:\d\d", out.getvalue())


def test_the_fields_of_exported_messages_are_the_coordinates(driven, plain, tmp_path, capsys):
    """As `rostopic echo -p` writes them: a comment as header, text, a quaternion, stamps in ns."""
    pose, twist = "field.pose.pose.", "field.twist.twist."
    names = [f"{pose}position.x", f"{pose}position.y", *(f"{pose}orientation.{part}" for part in "xyzw")]
    # The description calls the speeds v and w, and its inputs as the messages call the speeds.
    names += [f"{twist}linear.x", f"{twist}angular.z", "cmd v", "cmd w"]
    written = exported(driven, names, lambda t, position, turned, speeds: (*position, *turned, *speeds))
    places = ("--map", "v=speed", "w=turn rate", "speed=cmd v", "turn rate=cmd w")
    same(plain, imported(write_cells(tmp_path / "odom.csv", *written), *places), 1e-5)
    names[6] += " [km/h]"  # the unit counts once, whoever names it
    written = exported(driven, names, lambda t, position, turned, u: (*position, *turned, 3.6 * u[0], *u[1:]))
    for unit in ((), ("--unit", "v=km/h")):
        same(plain, imported(write_cells(tmp_path / "odom.csv", *written), *places, *unit), 1e-5)


@pytest.mark.parametrize("flat", [True, False])
def test_odometry_with_covariances_becomes_a_description(driven, tmp_path, capsys, flat):
    """A base writes z as noise of a nanometre. A camera in space estimates no speeds, and writes zeros."""
    rng, pose, twist = np.random.default_rng(0), ".pose.pose.", ".twist.twist."
    names = [f"{pose}position.{axis}" for axis in "xyz"] + [f"{pose}orientation.{part}" for part in "xyzw"]
    names += [f"{twist}linear.x", f"{twist}angular.z"] + [f".pose.covariance{k}" for k in range(6)]

    def fields(t, position, turned, others):
        z, speeds = (1e-10 * rng.normal(), others[:2]) if flat else (0.3 * math.sin(t), (0.0, 0.0))
        return (*position, z, *turned, *speeds, *rng.uniform(0.0, 0.01, 6))

    path, out = tmp_path / "odom.csv", tmp_path / "odom.toml"
    write_cells(path, *exported([part[:600] for part in driven], names, fields))
    assert main(["robot", "new", str(out), "--from", str(path)]) == 0
    assert f"as {'it changes by less than a millimetre: z' if flat else 'they never change: '}" in out.read_text()
    seen = ("heading [rad]", "speed [m/s]", "turn rate [rad/s]") if flat else ("z [m]", "heading [1]")
    assert robot_named(str(out)).state == ("x [m]", "y [m]", *seen)
