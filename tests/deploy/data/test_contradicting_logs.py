"""Columns that have the right unit and still describe something else: `import` refuses them, and says what to do."""

import math
import tomllib

import numpy as np
import pytest

from brakeline.deploy.cli import main
from brakeline.deploy.data.glitches import without_glitches
from brakeline.deploy.data.held_values import without_held_poses
from brakeline.deploy.data.sources.source_table import Table
from brakeline.sim.ground_estimator import wrap
from tests.deploy.data.porter import COLUMNS, FILE, Porter, drive, driven_by, joystick, write_csv

pytestmark = pytest.mark.usefixtures("reading_here")
X, Y, HEADING, V, W, SPEED, TURN = range(len(COLUMNS))
PERIOD = 10  # rows


@pytest.fixture(scope="module")
def driven():
    return drive(seconds=120.0)


def late(values, columns, rows):
    values[rows:, columns] = values[:-rows, columns]
    values[:rows, columns] = 0.0


def clockwise_from_y(values):
    values[:, HEADING] = wrap(math.pi / 2.0 - values[:, HEADING])


def swap(one, other):
    def swapped(values):
        values[:, [one, other]] = values[:, [other, one]]

    return swapped


def opposite(column):
    def negated(values):
        values[:, column] *= -1.0

    return negated


def of_another_drive(values):
    values[:, [SPEED, TURN]] = drive(seconds=120.0, seed=7)[1][:, [SPEED, TURN]]


def percent(values):
    values[:, SPEED] *= 100.0 / 0.6


def degrees_of_a_robot_that_slips(values):
    values[:, TURN] = np.degrees(1.2 * values[:, TURN])


def no_position(values):
    values[:, [X, Y, HEADING]] = 0.0


def nothing_sent(values):
    values[:, [SPEED, TURN]] = 0.0


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (opposite(Y), "Write -heading into the column, or change the sign of y"),
        (clockwise_from_y, "Write pi/2 - heading into the column, or swap the columns x and y"),
        (swap(X, Y), "or swap the columns x and y"),
        (swap(X, HEADING), "v, w have no relation to the motion of x, y, heading: columns of the pose are swapped"),
        (opposite(W), "w has the opposite sign of the turn rate of the positions"),
        (swap(V, W), "v follows the turn rate of the positions, not their speed: are two columns swapped?"),
        (swap(SPEED, TURN), "speed follows the turn rate of the positions"),
        (percent, "times the speed of the positions, and no unit explains this. Write speed in m/s"),
        (degrees_of_a_robot_that_slips, "it may be in deg/s. Convert it with --unit 'turn rate=deg/s'"),
        (lambda values: late(values, [SPEED, TURN], PERIOD), "Shift the stamps with --delay -0.2"),
        (lambda values: late(values, [SPEED, TURN], 4 * PERIOD), "Shift the stamps with --delay -0.8"),
        (of_another_drive, "v does not follow speed"),
        (no_position, "x, y never change: they do not hold the robot's position"),
        (nothing_sent, "speed is always 0, but v, which follows it, moves"),
    ],
)
def test_a_column_that_contradicts_the_motion_is_refused(driven, tmp_path, capsys, mistake, said):
    time, values = driven[0], driven[1].copy()
    mistake(values)
    status, text = imported(write_csv(tmp_path / "drive.csv", time, values), capsys)
    assert status == 1 and said in text and "Traceback" not in text


def test_a_position_of_something_else_is_noted(driven, tmp_path, capsys):
    """Its motion has no relation to the speed, so no unit, sign or swap explains it."""
    time, values = driven[0], driven[1].copy()
    status, text = imported(write_csv(tmp_path / "right.csv", time, values), capsys)
    assert status == 0 and "agrees little" not in text
    values[:, X] = 0.5 * np.sin(0.7 * time)
    status, text = imported(write_csv(tmp_path / "wrong.csv", time, values), capsys)
    assert status == 0 and "v agrees little with the motion of x, y, heading (correlation 0." in text
    assert "agrees little" not in imported(tmp_path / "wrong.csv", capsys, "--unit", "v=1")[1]


@pytest.fixture
def steered(driven):
    """A car's log, as a robot whose measured steering follows its input, and its file."""
    time, values = driven
    held, steering = values[:, TURN] / 3.0, np.zeros(len(time))
    for k in range(1, len(time)):
        steering[k] = steering[k - 1] + 0.2 * (held[k - 1] - steering[k - 1])
    return time, np.column_stack([values[:, :W], steering, values[:, SPEED], held])


@pytest.mark.parametrize(
    ("columns", "unit", "said"),
    [
        ([W], "", "angle looks like deg: it is 5"),
        ([TURN], "", "steering looks like deg: it is "),
        ([], "angle=deg", "angle is in rad already: only without --unit angle=deg"),
        ([W], "angle=deg", ""),
        ([W], "angle=1", ""),
    ],
)
def test_a_measured_angle_is_in_the_unit_of_the_input_that_it_follows(steered, tmp_path, capsys, columns, unit, said):
    """Degrees beside rad: neither the motion nor the correlation of both would show them."""
    time, values = steered[0], steered[1].copy()
    values[:, columns] = np.degrees(values[:, columns])
    text = FILE.read_text().replace('w = { unit = "rad/s"', 'angle = { unit = "rad"').replace("turn rate", "steering")
    robot = tmp_path / "porter.toml"
    robot.write_text(text.replace('"steering" = { unit = "rad/s"', '"steering" = { unit = "rad"'))
    path = write_csv(tmp_path / "drive.csv", time, values, ("x", "y", "heading", "v", "angle", "speed", "steering"))
    status, text = imported(path, capsys, *(["--unit", unit] if unit else []), robot=robot)
    assert (status == 0, said in text) == (not said, True), text


def omnidirectional_log(path, turned=1.0, along_axes=False, zero=0.0):
    """Write the log of a robot that drives in every direction while it turns.

    turned: the unit of its heading; zero: its heading if it looks along x.
    """
    rng, rows, pose, speeds, given = np.random.default_rng(0), [], np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(2400):
        if k % 2 == 0 and rng.random() < 0.1:
            given = rng.uniform([-0.8, -0.6, -0.3], [0.8, 0.6, 1.2]) * (rng.random() > 0.2)
        rotation = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
        linear, heading = (speeds[:2], pose[2]) if along_axes else (rotation @ speeds[:2], wrap(pose[2]))
        seen = [*pose[:2], zero + turned * heading, *speeds]
        rows.append([*(np.array(seen) + rng.uniform(-0.003, 0.003, 6)), *given])
        pose, speeds = pose + 0.05 * np.array([*linear, speeds[2]]), speeds + 0.3 * (given - speeds)
    names = ("x", "y", "heading", "ahead", "aside", "turn", "cmd_ahead", "cmd_aside", "cmd_turn")
    return write_csv(path, 0.05 * np.arange(2400), np.array(rows), names)


def test_the_speeds_of_an_omnidirectional_robot_show_that_its_heading_is_in_degrees(tmp_path, capsys):
    """Its direction of motion does not, and both commands blamed other columns, or took degrees for rad."""
    right, wrong = omnidirectional_log(tmp_path / "rad.csv"), omnidirectional_log(tmp_path / "deg.csv", 180.0 / math.pi)
    file, said = tmp_path / "omni.toml", "heading looks like degrees"
    assert main(["robot", "new", str(file), "--from", str(wrong)]) == 1
    assert said in capsys.readouterr().err and not file.exists()
    assert main(["robot", "new", str(file), "--from", str(right)]) == 0
    assert main(["robot", "new", str(tmp_path / "same.toml"), "--from", str(wrong), "--unit", "heading=deg"]) == 0
    assert tomllib.loads((tmp_path / "same.toml").read_text())["state"]["ahead"]["unit"] == "m/s"
    status, text = imported(wrong, capsys, robot=file)
    assert status == 1 and said in text
    status, text = imported(right, capsys, robot=file)
    assert status == 0, text
    status, text = imported(right, capsys, "--unit", "heading=deg", robot=file)
    assert status == 1 and "heading is in rad already" in text


@pytest.mark.parametrize(
    ("zero", "said"),
    [
        (0.0, "Write -heading into the column, or change the sign of y"),
        (math.pi / 2.0, "Write pi/2 - heading into the column, or swap the columns x and y"),
    ],
)
def test_the_speeds_of_an_omnidirectional_robot_show_that_its_heading_grows_clockwise(tmp_path, capsys, zero, said):
    """Its direction of motion does not: `robot new` noted nothing, and `import` that it may slip."""
    right, wrong = (
        omnidirectional_log(tmp_path / "right.csv"),
        omnidirectional_log(tmp_path / "wrong.csv", -1.0, zero=zero),
    )
    file = tmp_path / "omni.toml"
    assert main(["robot", "new", str(file), "--from", str(wrong)]) == 1
    assert said in capsys.readouterr().err and not file.exists()
    assert main(["robot", "new", str(file), "--from", str(right)]) == 0
    capsys.readouterr()
    status, text = imported(wrong, capsys, robot=file)
    assert status == 1 and said in text


def test_speeds_along_x_and_y_show_no_unit_of_the_heading(tmp_path, capsys):
    """A heading in rad that counts its turns changes slowly if it is read in degrees, and would fit them better."""
    log = omnidirectional_log(tmp_path / "world.csv", along_axes=True)
    assert main(["robot", "new", str(tmp_path / "omni.toml"), "--from", str(log)]) == 0
    assert "looks like" not in capsys.readouterr().out


def test_speeds_along_x_and_y_of_a_robot_with_a_heading_are_refused(tmp_path, capsys):
    """The model set predicts in the robot's frame, so its sets were wide, and a note said only that it may slip."""
    log, file = omnidirectional_log(tmp_path / "world.csv", along_axes=True), tmp_path / "omni.toml"
    assert main(["robot", "new", str(file), "--from", str(log)]) == 0
    said = "is a speed along x or y, but a robot with a heading needs speeds in its own frame"
    assert f"ahead {said}" in " ".join(capsys.readouterr().out.split())
    file.write_text(file.read_text().replace('unit = "1"', 'unit = "m/s"'))
    status, text = imported(log, capsys, robot=file)
    assert status == 1 and f"aside {said}" in text and "Write cos(heading) * vx + sin(heading) * vy (ahead)" in text
    names = ("ahead", "aside", "cmd_ahead", "cmd_aside")
    status, text = imported(log, capsys, "--unit", *(f"{name}=1" for name in names), robot=file)
    assert status == 0, text


def test_late_inputs_are_imported_with_the_delay_that_the_error_names(driven, tmp_path, capsys):
    time, values = driven[0], driven[1].copy()
    late(values, [SPEED, TURN], PERIOD)
    status, text = imported(write_csv(tmp_path / "drive.csv", time, values), capsys, "--delay", "-0.2")
    assert status == 0, text


def test_a_state_with_the_opposite_sign_can_be_taken_as_it_is(driven, tmp_path, capsys):
    time, values = driven[0], driven[1].copy()
    values[:, W] *= -1.0
    status, text = imported(write_csv(tmp_path / "drive.csv", time, values), capsys, "--unit", "w=1")
    assert status == 0, text


def test_an_input_with_the_opposite_sign_is_noted(driven, tmp_path, capsys):
    time, values = driven[0], driven[1].copy()
    values[:, TURN] *= -1.0
    status, text = imported(write_csv(tmp_path / "drive.csv", time, values), capsys)
    assert status == 0 and "turn rate: w changes in the opposite direction" in text and "speed: v" not in text


def test_a_speed_without_its_sign_is_refused(tmp_path, capsys):
    rng = np.random.default_rng(0)
    inputs = joystick(rng, 120.0)
    inputs[:, 0] *= np.where(np.arange(len(inputs)) // 500 % 2, -1.0, 1.0)  # backwards in every second 10 s
    time, values = driven_by(Porter(rng), inputs)
    robot = tmp_path / "porter.toml"
    robot.write_text(FILE.read_text().replace("low = 0.0", "low = -0.6"))
    status, text = imported(write_csv(tmp_path / "signed.csv", time, values), capsys, robot=robot)
    assert status == 0, text
    values[:, V] = np.abs(values[:, V])
    status, text = imported(write_csv(tmp_path / "unsigned.csv", time, values), capsys, robot=robot)
    assert status == 1 and "v is positive while the robot drives backwards: it has no sign" in text


def test_a_new_description_names_what_a_log_cannot_show(driven, tmp_path, capsys):
    path = write_csv(tmp_path / "drive.csv", *driven)
    assert main(["robot", "new", str(tmp_path / "my.toml"), "--from", str(path)]) == 0
    assert "the log does not show the body, `sight` and the measurement errors" in " ".join(
        capsys.readouterr().out.split()
    )


def test_stamps_in_no_unit_of_time_are_refused(driven, tmp_path, capsys):
    """A log whose rows are numbered as if there were 500 a second, not 50."""
    time, values = driven
    path = write_csv(tmp_path / "drive.csv", time, values)
    cells = [line.split(",", 1) for line in path.read_text().splitlines()[1:]]
    path.write_text("\n".join([f"time,{','.join(COLUMNS)}", *(f"{0.1 * float(t):.3f},{rest}" for t, rest in cells)]))
    status, text = imported(path, capsys)
    assert status == 1 and "No unit of time explains this: write the time in s" in text


def test_rows_in_the_opposite_order_are_named(driven, tmp_path, capsys):
    time, values = driven
    status, text = imported(write_csv(tmp_path / "drive.csv", time[::-1], values[::-1]), capsys)
    assert status == 1 and "the time runs backwards from row to row. Write the rows in the opposite order" in text


def test_decimal_commas_between_commas_are_named(driven, tmp_path, capsys):
    path = write_csv(tmp_path / "drive.csv", *driven)
    path.write_text(path.read_text().replace(".", ","))
    status, text = imported(path, capsys)
    assert status == 1 and "If the numbers have decimal commas, write the file with semicolons" in text


@pytest.mark.parametrize(("period", "noted"), [(0.1, False), (0.2, False), (0.25, True), (0.05, True), (1.0, True)])
def test_a_period_that_is_not_the_controllers_is_noted(driven, tmp_path, capsys, period, noted):
    """The joystick of the log speaks every 0.1 s."""
    robot = tmp_path / "porter.toml"
    robot.write_text(FILE.read_text().replace("period = 0.2", f"period = {period}"))
    held = driven[1].copy()
    if period == 0.2:  # whose inputs change every 0.2 s
        held[:, [SPEED, TURN]] = held[np.arange(len(held)) // PERIOD * PERIOD][:, [SPEED, TURN]]
    status, text = imported(write_csv(tmp_path / "drive.csv", driven[0], held), capsys, robot=robot)
    assert ("inputs change at multiples of 0.1 s" in text and "write `period = 0.1`" in text) == noted, (status, text)


def test_a_period_below_the_delay_is_not_proposed(driven, tmp_path, capsys):
    """One note said to write a period of 0.1 s, and the next one that predictions need a longer one than that."""
    held = driven[1].copy()
    late(held, [X, Y, HEADING, V, W], PERIOD - 2)
    status, text = imported(write_csv(tmp_path / "drive.csv", driven[0], held), capsys)
    assert status == 0 and "keep that period, because the delay is longer than 0.1 s" in text, (status, text)
    assert "hold each input for 0.2 s" in text and "write `period" not in text


def test_a_period_is_not_proposed_to_itself(driven, tmp_path, capsys):
    """Of changes that a log shows late: "multiples of 0.1 s, but the description's period is 0.1 s"."""
    rng, robot = np.random.default_rng(3), tmp_path / "porter.toml"
    robot.write_text(FILE.read_text().replace("period = 0.2", "period = 0.1"))
    held = driven[1].copy()
    for k in range(5, len(held), 5):  # the joystick speaks every five rows
        if rng.random() < 0.2:
            held[k, [SPEED, TURN]] = driven[1][k - 1, [SPEED, TURN]]
    status, text = imported(write_csv(tmp_path / "drive.csv", driven[0], held), capsys, robot=robot)
    assert "of the periods an input changed" in text and "multiples of 0.1 s" not in text, (status, text)


def test_a_converted_column_is_in_si_whatever_its_name_says(driven, tmp_path, capsys):
    values = driven[1].copy()
    values[:, HEADING] = np.degrees(values[:, HEADING])
    path, robot = write_csv(tmp_path / "drive.csv", driven[0], values), tmp_path / "my.toml"
    path.write_text(path.read_text().replace("heading", "yaw_deg", 1))
    assert main(["robot", "new", str(robot), "--from", str(path), "--unit", "yaw_deg=deg"]) == 0
    note = "Requests and decisions have yaw_deg in rad, whatever its name says"
    assert note in " ".join(capsys.readouterr().out.split()) and note in robot.read_text()


def test_an_error_below_the_noise_at_rest_is_noted(tmp_path, capsys):
    """The porter's positions are measured within 4 mm."""
    rng = np.random.default_rng(1)
    inputs = joystick(rng, 120.0)
    inputs[2000:3000] = 0.0  # it stands for 20 s
    path = write_csv(tmp_path / "drive.csv", *driven_by(Porter(rng), inputs))
    status, text = imported(path, capsys)
    assert status == 0 and "while the robot stands" not in text
    robot = tmp_path / "porter.toml"
    robot.write_text(FILE.read_text().replace("error = 0.01 }", "error = 0.001 }"))
    status, text = imported(path, capsys, robot=robot)
    assert status == 0 and "x varies by ±0.00" in text and "the description states `error = 0.001`" in text


def test_inputs_beyond_their_bounds_are_named_with_their_range(driven, tmp_path, capsys):
    robot = tmp_path / "porter.toml"
    robot.write_text(FILE.read_text().replace("high = 0.6", "high = 0.4"))
    status, text = imported(write_csv(tmp_path / "drive.csv", *driven), capsys, robot=robot)
    assert status == 0 and "(speed 0 to 0.6, bounds 0 to 0.4)" in text
    assert "windows of a plan's length (5 periods; they overlap)" in text


def test_an_input_far_beyond_its_bounds_is_in_another_unit(driven, tmp_path, capsys):
    """In percent, only values below 1 % are within bounds of 1: the robot would seem to stand at full speed."""
    time, values = driven[0], driven[1].copy()
    robot, text = tmp_path / "porter.toml", FILE.read_text()
    text = text.replace(', follows = "speed"', "").replace('speed = { unit = "m/s"', 'speed = { unit = "1"')
    text = text.replace("high = 0.6", "high = 1.0")
    robot.write_text(text)
    values[:, SPEED] *= 100.0 / 0.6
    path = write_csv(tmp_path / "drive.csv", time, values)
    status, text = imported(path, capsys, robot=robot)
    assert status == 1 and "speed 0 to 100, bounds 0 to 1: speed is in another unit" in text
    status, text = imported(path, capsys, "--unit", "speed=1", robot=robot)
    assert "an input was outside the robot's bounds (speed 0 to 100, bounds 0 to 1)" in text
    values[:, SPEED] /= 100.0
    assert imported(write_csv(path, time, values), capsys, robot=robot)[0] == 0


def test_a_rare_input_within_its_bounds_is_not_said_to_be_cut():
    values = np.linspace(0.0, 0.1, 500)
    values[[100, 300]] = 0.9, 9.0
    table = Table("", np.arange(500.0), {"speed": values}, np.zeros(500, np.intp))
    places, notes = without_glitches({"speed": (table, "speed")}, [], "", {"speed": (0.0, 1.0)})
    assert places["speed"][0] is table, "both stay"
    assert [note.partition(": ")[2].split(": ")[-1] for note in notes] == [
        "the recording is cut there",
        "it counts, as it is within the bounds of the input",
    ]


# --- poses that are no measurements ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("columns", "names"), [(slice(W + 1), "x, y, heading"), ([X, Y], "x, y")])
def test_rows_that_repeat_a_pose_are_no_measurements(driven, tmp_path, capsys, figures, columns, names):
    """As many positions per period, and as large a chord deviation, as the log without these rows."""
    time, values = driven
    held = values.copy()
    held[:, columns] = values[np.arange(len(values)) // 5 * 5][:, columns]
    path, out = write_csv(tmp_path / "held.csv", time, held), tmp_path / "a.safetensors"
    report = figures("import", path, "--robot", FILE, "--out", out)["report"]
    assert any(note.startswith(f"{names} change only in every 5th row") for note in report["notes"])
    sparse = write_csv(tmp_path / "sparse.csv", time[::5], values[::5])
    honest = figures("import", sparse, "--robot", FILE, "--out", out)["report"]
    assert report["samples"] == honest["samples"] == 2
    assert report["chord_deviation"] == pytest.approx(honest["chord_deviation"], rel=0.05)


def test_whole_centimetres_of_a_slow_robot_are_measurements(driven, tmp_path, figures):
    time, values = driven[0], driven[1].copy()
    values[:, [V, SPEED]] *= 0.2
    values[:, [X, Y]] = np.round(0.2 * values[:, [X, Y]], 2)
    path, out = write_csv(tmp_path / "slow.csv", time, values), tmp_path / "a.safetensors"
    report = figures("import", path, "--robot", FILE, "--out", out)["report"]
    assert report["samples"] == 10 and not any("repeat" in note for note in report["notes"])


def test_repeated_states_in_joint_space_are_no_measurements(driven):
    time, values = driven[0], driven[1].copy()
    values[:, [X, Y]] = values[np.arange(len(values)) // 5 * 5][:, [X, Y]]
    table = Table("", time, {"q1": values[:, X], "q2": values[:, Y]}, np.zeros(len(time), np.intp))
    places, notes = without_held_poses({name: (table, name) for name in table.columns}, [], "", ["q1", "q2"])
    assert [note[:38] for note in notes] == ["q1, q2 change only in every 5th row: t"]
    assert all(np.isfinite(of.columns[name]).mean() == pytest.approx(0.2, abs=0.01) for of, name in places.values())


def test_a_pose_that_is_lost_for_seconds_is_left_out(driven, tmp_path, capsys, figures):
    time, values = driven[0], driven[1].copy()
    values[2000:2500, : W + 1] = values[2000, : W + 1]
    path, out = write_csv(tmp_path / "lost.csv", time, values), tmp_path / "a.safetensors"
    report = figures("import", path, "--robot", FILE, "--out", out)["report"]
    assert any("line 2002: the pose stays the same for 9.98 s, then jumps" in note for note in report["notes"])
    assert report["periods"] <= 600 - 10.0 / 0.2


def test_a_robot_that_stands_may_repeat_its_pose(driven, tmp_path, capsys, figures):
    time, values = driven[0], driven[1].copy()
    for k in (
        np.flatnonzero((np.abs(values[1:, V]) < 0.03) & (values[1:, SPEED] == 0.0) & (values[1:, TURN] == 0.0)) + 1
    ):
        values[k, : W + 1] = values[k - 1, : W + 1]
    path, out = write_csv(tmp_path / "quiet.csv", time, values), tmp_path / "a.safetensors"
    report = figures("import", path, "--robot", FILE, "--out", out)["report"]
    assert report["samples"] == 10 and not any("repeat" in note or "jump" in note for note in report["notes"])


def imported(path, capsys, *words, robot=FILE):
    status = main(["import", str(path), "--robot", str(robot), "--out", str(path.with_suffix(".safetensors")), *words])
    printed = capsys.readouterr()
    return status, " ".join((printed.out + printed.err).split())
