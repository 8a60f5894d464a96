"""Recordings of any robot, in any format, become the same data set; and what they lack is said."""

import re
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from brakeline.deploy.cli import main
from brakeline.deploy.data.coverage import coverage, draw_coverage
from brakeline.deploy.data.importer import import_sources, tables_of
from brakeline.deploy.data.log_options import LogOptions
from brakeline.deploy.data.resample import resample
from brakeline.deploy.data.sources.source_table import Table
from brakeline.errors import BadData, NoSource
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.repeated_driving import repeated_driving
from brakeline.safety.model.windows import _off_chord
from tests.deploy.data.bags import (
    write_bag,
    write_bin,
    write_json_lines,
    write_parquet,
    write_parquet_folder,
    write_ros1_bag,
    write_text_log,
)
from tests.deploy.data.porter import COLUMNS, FILE, STEP, Porter, drive, porter, write_csv

pytestmark = pytest.mark.usefixtures("reading_here")


@pytest.fixture(scope="module")
def driven():
    return drive(seconds=60.0)


@pytest.fixture(scope="module")
def from_csv(driven, tmp_path_factory):
    return import_sources([write_csv(tmp_path_factory.mktemp("logs") / "drive.csv", *driven)], porter()).data


def same(one: Dataset, other: Dataset, within: float) -> None:
    assert len(one.trajectories) == len(other.trajectories)
    for a, b in zip(one.trajectories, other.trajectories, strict=True):
        for name in ("states", "inputs", "paths", "turned", "before"):
            assert np.allclose(getattr(a, name), getattr(b, name), rtol=0.0, atol=within), name
    assert one.chord_deviation == pytest.approx(other.chord_deviation, abs=within)


SOURCES = {
    "sqlite bag": (lambda folder, *drive: write_bag(folder / "bag", *drive), 1e-9),
    "mcap bag": (lambda folder, *drive: write_bag(folder / "bag", *drive, storage=StoragePlugin.MCAP), 1e-9),
    "mcap alone": (lambda folder, *drive: write_bag(folder / "b", *drive, storage=StoragePlugin.MCAP) / "b.mcap", 1e-9),
    "ROS 1 bag": (lambda folder, *drive: write_ros1_bag(folder / "a.bag", *drive), 1e-9),
    "parquet": (lambda folder, *drive: write_parquet(folder / "a.parquet", *drive), 1e-9),
    "JSON lines": (lambda folder, *drive: write_json_lines(folder / "a.jsonl", *drive), 1e-9),
    "folder of Parquet files": (lambda folder, *drive: write_parquet_folder(folder / "parts", *drive), 1e-9),
    "rover's log": (lambda folder, *drive: write_bin(folder / "a.bin", *drive), 1e-5),
    "rover's log as text": (lambda folder, *drive: write_text_log(folder / "a.log", *drive), 1e-5),
}


@pytest.mark.parametrize("source", SOURCES)
def test_every_format_of_the_same_drive_is_the_same_data(driven, from_csv, tmp_path, source):
    write, within = SOURCES[source]
    same(from_csv, import_sources([write(tmp_path, *driven)], porter()).data, within)


@pytest.mark.parametrize("source", ["sqlite bag", "mcap bag", "ROS 1 bag", "rover's log", "rover's log as text"])
def test_a_clock_that_begins_again_cuts_messages_as_it_cuts_columns(driven, tmp_path, source):
    time, values = driven[0][:2000].copy(), driven[1][:2000]
    time[1000:] -= time[1000]
    columns = import_sources([write_csv(tmp_path / "drive.csv", time, values)], porter())
    write, within = SOURCES[source]
    messages = import_sources([write(tmp_path, time, values)], porter())
    same(columns.data, messages.data, within)
    said = "line 1002: the time goes back from 19.98 to 0 s: the recording is cut there"
    assert any(said in note for note in columns.report.notes)
    assert any("time steps back by 19.98 s" in note and "cut there" in note for note in messages.report.notes)


def test_the_files_of_a_bag_are_read_in_the_order_of_their_numbers(driven, tmp_path):
    time, values = driven[0][:1200], driven[1][:1200]
    whole = tables_of(write_bag(tmp_path / "whole", time, values))
    folder = tmp_path / "split"
    folder.mkdir()
    for i, rows in enumerate(np.array_split(np.arange(1200), 12)):
        write_bag(tmp_path / f"part{i}", time[rows], values[rows])
        (tmp_path / f"part{i}" / f"part{i}.db3").rename(folder / f"split_{i}.db3")
    parts = tables_of(folder)
    (one,), (other,) = ([t for t in tables if t.name == "/odom"] for tables in (whole, parts))
    assert np.array_equal(one.time, other.time) and not np.any(other.run) and not other.notes


def test_one_of_several_odometries_is_taken_the_others_are_named_and_can_be_chosen(driven, tmp_path):
    topics = {"/odom_noisy": 0.3, "/odom": 0.0, "/odom_kf": 0.1}
    path = write_bag(tmp_path / "three", driven[0][:2000], driven[1][:2000], odometry=topics)
    said = "from /odom; /odom_noisy, /odom_kf also hold them (choose with --topics /odom_noisy)"
    plain = import_sources([path], porter())
    assert any(said in note for note in plain.report.notes), plain.report.notes
    mapped = LogOptions(fields={name: f"/odom_kf/position.{name}" for name in "xy"})
    for options, off in ((LogOptions(topics=("/odom_kf",)), 0.1), (mapped, 0.1)):
        chosen = import_sources([path], porter(), options).data.trajectories[0]
        assert np.allclose(chosen.states - plain.data.trajectories[0].states, [off, 0.0, 0.0, 0.0, 0.0])
    toml = tmp_path / "a.toml"
    assert main(["robot", "new", str(toml), "--from", str(path)]) == 0
    assert said in toml.read_text()
    places = ("x=/odom_kf/position.x", "y=/odom_kf/position.y")
    toml.unlink()
    assert main(["robot", "new", str(toml), "--from", str(path), "--map", *places]) == 0
    assert "x, y: from /odom_kf; /odom_noisy, /odom also hold them" in toml.read_text()


def test_a_recording_counts_once_under_whatever_name(driven, from_csv, tmp_path):
    one, copy = (write_csv(tmp_path / name, *driven) for name in ("a.csv", "b.csv"))
    with pytest.raises(NoSource, match=r"a\.csv and .*b\.csv hold the same driving, \d\d s in all"):
        import_sources([one, copy], porter())
    both = tmp_path / "both.csv"
    both.write_bytes(one.read_bytes() + one.read_bytes())
    with pytest.raises(BadData, match=r"hold the same driving, \d\d s in all: a copy is no evidence"):
        import_sources([both], porter())
    twice = replace(from_csv, trajectories=from_csv.trajectories * 2)
    twice.save(tmp_path / "twice.safetensors")
    with pytest.raises(BadData, match="a copy is no evidence"):
        Dataset.load(tmp_path / "twice.safetensors")
    other = write_csv(tmp_path / "other.csv", *drive(seconds=60.0, seed=5))
    assert import_sources([one, other], porter()).data.periods > 1.9 * from_csv.periods


def test_a_note_on_several_files_is_said_once(tmp_path):
    paths = []
    for seed in range(5):
        time, values = drive(seconds=20.0, seed=seed)
        kept = np.ones(len(time), dtype=bool) if seed == 4 else (time < 8.0) | (time > 11.0)
        paths.append(write_csv(tmp_path / f"{seed}.csv", time[kept], values[kept]))
    said = "gaps, at which the recording is cut: 1"
    for some, names in ((paths[:2], "all files"), (paths[1:], "1.csv, 2.csv, 3.csv"), (paths[:1], "")):
        notes = [note for note in import_sources(some, porter()).report.notes if "gaps" in note]
        assert notes == [f"{names}: {said}" if names else said]
    assert f"0.csv, 1.csv, 2.csv and 1 more: {said}" in import_sources(paths, porter()).report.notes


def test_a_column_with_missing_cells_is_named(driven):
    """A tenth of the speeds lost a third of the log, and nothing said why."""
    time, values = driven[0], driven[1].copy()
    values[np.random.default_rng(0).random(len(time)) < 0.5, 3] = np.nan
    notes = resample([table(time, values)], porter(), LogOptions()).report.notes
    said = [note for note in notes if "empty or NaN" in note]
    assert len(said) == 1
    assert re.fullmatch(r"v is empty or NaN in (49|50|51)\.\d% of the rows: .* the recording is cut", said[0])
    assert any(re.fullmatch(r"gaps, at which the recording is cut: \d+", note) for note in notes)


def test_a_part_of_a_recording_and_a_later_copy_count_as_copies_too(driven):
    time, values = driven
    whole, part = (
        resample([table(time[rows], values[rows])], porter(), LogOptions()).data for rows in (time > -1.0, time > 15.99)
    )
    twice = repeated_driving(porter(), whole.trajectories + part.trajectories)
    assert twice is not None and twice.seconds > 40.0, "resampling rounds"
    later = table(np.r_[time, time + time[-1] + 31.3], np.vstack([values, values]))
    with pytest.raises(BadData, match="a copy is no evidence"):  # its heading is unwrapped on and on
        resample([later], porter(), LogOptions())


# --- periods out of columns --------------------------------------------------------------------------------------


def table(time, values, **columns) -> Table:
    named = dict(zip(COLUMNS, values.T, strict=True)) | columns
    run = named.pop("run", np.zeros(len(time))).astype(np.intp)
    return Table("", np.asarray(time), named, run)


def steady(step=0.2, turn=0.0):
    """20 s of a robot that drives steadily, without noise: (time, values)."""
    time = step * np.arange(round(20.0 / step) + 1)
    speed, heading = 0.3, turn * time
    x = np.cumsum(speed * step * np.cos(heading))
    y = np.cumsum(speed * step * np.sin(heading))
    one = np.ones(len(time))
    wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
    return time, np.column_stack([x, y, wrapped, speed * one, turn * one, speed * one, turn * one])


def lengths(imported) -> list[int]:
    """Of the pieces, put together again where one was dealt out in parts."""
    found, last = [], None
    for t in imported.data.trajectories:
        joined = last is not None and np.array_equal(last, t.states[0])
        found = [*found[:-1], found[-1] + len(t.inputs)] if joined else [*found, len(t.inputs)]
        last = t.states[-1]
    return found


def test_a_recording_at_the_robots_period_is_taken_as_it_is():
    time, values = steady()
    made = resample([table(time, values)], porter(), LogOptions())
    states = np.vstack([t.states[:-1] for t in made.data.trajectories] + [made.data.trajectories[-1].states[-1:]])
    assert np.allclose(states, values[1:, :5]) and made.report.samples == 1
    assert lengths(made) == [99], "the first period tells the input in force"


@pytest.mark.parametrize(
    ("rows", "runs", "samples"),
    [
        ([*range(0, 15_000, 5), *range(1, 15_000, 5)], 1, 2),  # in pairs, 0.02 and 0.08 s apart
        ([*range(10_000), *range(10_000, 15_000, 10)], 2, 1),  # a fast run, and a slow one
    ],
)
def test_the_positions_of_a_period_count_where_they_are_few(rows, runs, samples):
    """Rows that are near each other say nothing about the path in the time without rows."""
    time, values = drive(seconds=300.0, seed=4)
    rows = np.sort(rows)
    sparse = replace(table(time[rows], values[rows]), run=(rows >= 10_000).astype(np.intp) * (runs - 1))
    assert resample([sparse], porter(), LogOptions()).report.samples == samples


def test_the_positions_of_a_period_are_those_of_the_slowest_coordinate():
    time, values = drive(seconds=120.0, seed=4)
    whole = table(time, values)
    seldom = whole.columns["y"].copy()
    seldom[np.arange(len(time)) % 5 > 0] = np.nan
    sparse = replace(whole, columns=whole.columns | {"y": seldom})
    assert [resample([one], porter(), LogOptions()).report.samples for one in (whole, sparse)] == [10, 2]


def test_a_state_between_two_samples_shows_nothing_of_the_input_that_follows_it():
    """Odometry every 40 ms, 20 ms beside the inputs, as two nodes that know nothing of each other publish them."""
    robot, rng = Porter(np.random.default_rng(0)), np.random.default_rng(1)
    inputs = rng.uniform(porter().low(), porter().high(), (100, 2))
    true, rows = [], []
    for u in inputs:
        true.append(robot.true)
        for wait in (0.02, *(0.04,) * 4, 0.02):
            robot.step(u, wait)
            rows.append(robot.true)
        rows.pop()
    odometry = Table("/odom", 0.02 + 0.04 * np.arange(len(rows)), dict(zip(COLUMNS, np.array(rows).T, strict=False)))
    commands = Table("/cmd", 0.2 * np.arange(len(inputs)), dict(zip(COLUMNS[5:], inputs.T, strict=True)))
    places = {name: f"/odom/{name}" for name in COLUMNS[:5]} | {name: f"/cmd/{name}" for name in COLUMNS[5:]}
    made = resample([odometry, commands], porter(), LogOptions(fields=places)).data.joined()
    (t,) = made.trajectories
    first = int(np.flatnonzero((inputs == t.inputs[0]).all(1))[0])
    off = np.abs(t.states[:-1] - np.array(true)[first : first + len(t.inputs)])
    assert len(t.inputs) > 95 and off[:, 3].max() < 0.02 and off[:, 4].max() < 0.05


def test_cut_at_gaps_jumps_runs_and_inputs_out_of_bounds():
    time, values = steady()
    kept = np.r_[0:30, 31:101]
    assert lengths(resample([table(time[kept], values[kept])], porter(), LogOptions())) == [28, 68]
    jumped = values + np.where(np.arange(101)[:, None] >= 40, [2.0, 0, 0, 0, 0, 0, 0], 0.0)
    made = resample([table(time, jumped)], porter(), LogOptions())
    assert lengths(made) == [38, 59] and "jumps of the pose, at which the recording is cut: 1" in made.report.notes
    twice = (
        np.r_[time, time],
        np.vstack([values, values + np.eye(7)[0]]),
    )  # one metre beside: the same driving twice is refused
    runs = resample([table(*twice, run=np.repeat([0, 1], 101))], porter(), LogOptions())
    assert lengths(runs) == [99, 99]
    with pytest.raises(NoSource, match="time goes back from 20 to 0 s"):
        resample([table(*twice)], porter(), LogOptions())
    values[50, 5] = 0.7
    made = resample([table(time, values)], porter(), LogOptions())
    assert lengths(made) == [49, 48] and "1 periods left out: an input was outside" in made.report.notes[0]


@pytest.mark.parametrize("stamped", [0.0, 1764460000.0])  # s: where the clock begins
def test_a_lost_row_within_half_a_period_is_no_gap_whatever_the_clock(stamped):
    time, values = steady(step=0.05)
    kept = np.delete(np.arange(401), np.arange(20, 380, 7))
    assert lengths(resample([table(stamped + time[kept], values[kept])], porter(), LogOptions())) == [99]
    kept = np.delete(np.arange(401), [200, 201])
    assert len(lengths(resample([table(stamped + time[kept], values[kept])], porter(), LogOptions()))) == 2


def with_messages(given, lost=()) -> Table:
    """Return a table with a row for each pose (20 Hz) and for each message of both inputs that was not lost (5 Hz)."""
    time, values = steady(step=0.05)
    sent = np.delete(np.arange(len(given)), list(lost))
    poses = np.hstack([values[:, :5], np.full((len(time), 2), np.nan)])
    messages = np.hstack([np.full((len(sent), 5), np.nan), given[sent]])
    stamps = np.r_[time, 0.2 * sent]
    order = np.argsort(stamps, kind="stable")
    return table(stamps[order], np.vstack([poses, messages])[order])


def test_cut_where_a_message_of_an_input_that_changes_is_lost():
    given = np.tile([0.3, 0.0], (101, 1))
    given[:, 0] -= 0.01 * (np.arange(101) % 7)
    given[70:80, 0] = 0.3
    whole = resample([with_messages(given)], porter(), LogOptions())
    cut = resample([with_messages(given, lost=[30, 75])], porter(), LogOptions())
    note = "changes of an input while messages of it are missing, at which the recording is cut: 1"
    assert lengths(whole) == [99] and lengths(cut) == [29, 68] and note in cut.report.notes
    of_all, left = (np.vstack([t.inputs for t in made.data.trajectories]) for made in (whole, cut))
    assert np.allclose(left, np.delete(of_all, [29, 30], axis=0))


def test_a_sender_that_is_silent_while_nothing_changes_loses_no_messages():
    given = np.tile([0.3, 0.0], (101, 1))
    given[:, 0] -= 0.05 * (np.arange(101) // 3 % 2)
    sent = [0, *(np.flatnonzero(np.diff(given[:, 0]) != 0.0) + 1)]
    silent = sorted(set(range(101)) - set(sent) - set(range(0, 101, 6)))
    assert lengths(resample([with_messages(given, lost=silent)], porter(), LogOptions())) == [99]


@pytest.mark.parametrize("later", [0.0, 0.01])  # s, of the second robot's rows
def test_rows_of_two_robots_are_refused_and_a_column_tells_them_apart(later):
    time, values = steady(step=0.1)
    times, both = np.r_[time, time + later], np.vstack([values, values + 3.0 * np.eye(7)[0]])
    order = np.argsort(times, kind="stable")
    with pytest.raises(NoSource, match="are these rows of several robots"):
        resample([table(times[order], both[order])], porter(), LogOptions())
    told_apart = table(times, both, run=np.repeat([0, 1], len(time)))
    assert lengths(resample([told_apart], porter(), LogOptions())) == [99, 99]


def test_a_robot_that_is_put_back_every_few_seconds_is_one_robot():
    time, values = steady(step=0.1)
    values[:, 0] -= 3.0 * (np.arange(len(time)) // 30)  # m
    made = resample([table(time, values)], porter(), LogOptions())
    assert lengths(made) == [13] * 6 + [9]


def test_rows_with_the_same_stamp_are_named(driven):
    time, values = driven[0][:2000], driven[1][:2000]
    made = resample([table(np.floor(time * 10.0 + 1e-6) / 10.0, values)], porter(), LogOptions())
    said = "rows with the stamp of the row before and another pose, which are left out: "
    assert any(said in note for note in made.report.notes)


def test_angles_are_unwrapped_before_they_are_looked_at_in_between():
    time, values = steady(step=0.06, turn=1.0)
    made = resample([table(time, values)], porter(), LogOptions())
    turned = np.concatenate([t.turned for t in made.data.trajectories])
    assert np.allclose(turned, 0.2, atol=1e-9)


def test_an_input_is_held_and_forgotten_after_a_while():
    time, values = steady()
    values[20:40, 5:] = np.nan  # nobody spoke for 4 s
    made = resample([table(time, values)], porter(), LogOptions(), hold=1.0)
    assert lengths(made) == [23, 59], "5 periods after its last word it is forgotten"
    said = "pauses of more than 1 s between messages of an input: 1. The recording leaves out what follows"
    assert any(said in note and "give a larger --hold" in note for note in made.report.notes)
    values[50:, 5:] = np.nan  # its last message counts, too
    ended = resample([table(time, values)], porter(), LogOptions(), hold=1.0)
    assert lengths(ended) == [23, 13] and any(said.replace(": 1", ": 2") in note for note in ended.report.notes)
    time, values = steady()
    values[20:40, 5:] = np.nan
    made = resample([table(time, values)], porter(), LogOptions(), hold=10.0)
    assert lengths(made) == [99] and not any("no message of an input" in note for note in made.report.notes)


def test_periods_begin_where_inputs_change_and_an_input_that_changed_within_counts_by_its_mean():
    time, values = steady(step=0.02)
    beat = np.floor((time - 0.06 + 1e-9) / 0.2)
    values[:, 5] = 0.1 + 0.05 * (beat % 3)
    made = resample([table(time, values)], porter(), LogOptions())
    inputs = np.concatenate([t.inputs[:, 0] for t in made.data.trajectories])
    assert set(np.round(inputs, 9)) == {0.1, 0.15, 0.2} and made.report.uneven == 0.0
    values[:, 5] = np.where((time % 0.2) < 0.049, 0.2, 0.4)
    values[:, 6] = np.repeat(np.arange(len(time) // 10 + 1), 10)[: len(time)] % 2  # the beat is this one's
    made = resample([table(time, values)], porter(), LogOptions())
    inputs = np.concatenate([t.inputs[:, 0] for t in made.data.trajectories])
    assert np.allclose(inputs, 0.35, atol=0.03) and made.report.uneven > 0.5


@pytest.mark.parametrize("late", [0.0, 0.08, 0.16])
def test_the_delay_from_input_to_motion_is_found(late):
    time, values = drive(seconds=120.0, seed=3)
    told = table(time - late, values)  # as if commands were stamped earlier than they reached the robot
    inputs = Table("", told.time, {name: told.columns[name] for name in COLUMNS[5:]}, told.run)
    seen = table(time, values)
    states = Table("", time, {name: seen.columns[name] for name in COLUMNS[:5]}, seen.run)
    made = resample([states, inputs], porter(), LogOptions())
    for found in made.report.delays.values():
        assert found == pytest.approx(late, abs=0.03)
    shifted = resample([states, inputs], porter(), LogOptions(), delay=late)
    assert max(shifted.report.delays.values()) <= 0.021


def test_the_delay_is_the_same_whatever_the_clock():
    """Stamps since 1970 are rounded to 0.2 µs, so an input seems to change a little after its row."""
    time, values = drive(seconds=120.0, seed=3)
    late = np.hstack([values[:-8, :5], values[8:, 5:]])
    by_clock = []
    for stamped in (0.0, 1764460000.0):
        stamps = stamped + time[:-8:4]
        by_clock.append(resample([table(stamps - stamps[0], late[::4])], porter(), LogOptions()).report.delays)
    assert by_clock == [pytest.approx({"speed": 0.16, "turn rate": 0.16})] * 2


def test_paths_between_samples_are_within_the_bound_that_is_said():
    """Seen once a period only, by a robot that changes its mind within one: the bulge holds what was not seen."""
    rng = np.random.default_rng(5)
    robot, rows, truth = Porter(rng), [], []
    for _ in range(400):
        u = rng.uniform([0.0, -1.5], [0.6, 1.5])
        rows.append([*robot.true, *u])
        before = robot.true[:2].copy()
        truth.append(robot.step(u, 0.2) - before)
    made = resample([table(0.2 * np.arange(400), np.array(rows))], porter(), LogOptions())
    assert made.report.samples == 1 and "one position per period" in " ".join(made.report.notes)
    away = _off_chord(np.array(truth))
    assert away.max() <= made.data.chord_deviation < 0.08, (away.max(), made.data.chord_deviation)


def test_what_is_missing_is_named_with_what_there_is(tmp_path, driven):
    path = write_csv(tmp_path / "a.csv", *driven)
    path.write_text(path.read_text().replace("time,x,y,heading,v,", "time,x,why,heading,v,", 1))
    with pytest.raises(NoSource, match=r"y: there is no column 'y' .*\nThe source contains: columns: x, why, heading"):
        import_sources([path], porter())
    assert import_sources([path], porter(), LogOptions.parse(["y=why"])).report.periods > 250
    with pytest.raises(NoSource, match="one of x, y, heading, v, w, speed, turn rate"):
        import_sources([path], porter(), LogOptions.parse(["z=why"]))
    with pytest.raises(NoSource, match=r"heading: y is from why too; name another field for one of them with --map"):
        import_sources([path], porter(), LogOptions.parse(["y=why", "heading=why"]))
    slow = write_csv(tmp_path / "slow.csv", driven[0][::25], driven[1][::25])
    with pytest.raises(NoSource, match=r"a sample every 0.5 s: the robot's period of 0.2 s"):
        import_sources([slow], porter())
    bad = tmp_path / "bad.csv"
    bad.write_text("time,x\n0.0,one\n0.1,two\n")
    with pytest.raises(NoSource, match=r"bad.csv, column x, line 2: it holds text \('one'\): the column is left out"):
        import_sources([bad], porter())
    with pytest.raises(NoSource, match=r"Brakeline reads \.csv, \.parquet"):
        tables_of(FILE)


# --- what is said of it ------------------------------------------------------------------------------------------


def test_one_field_of_a_message_is_not_two_inputs(driven):
    """The turn rate of a Twist is not the speed of the left wheel, and of the right wheel."""
    robot = replace(porter(), action=("left [rad/s]", "right [rad/s]"), follows=(-1, -1))
    time, values = driven
    names = ("position.x", "position.y", "yaw", "body.x", "yaw rate", "command.body.x", "command.yaw rate")
    columns = dict(zip(names, values.T, strict=True))
    with pytest.raises(NoSource, match=r"right: left is from command\.yaw rate too.*--map 'right'=TABLE/FIELD"):
        resample([Table("/odom", time, columns, np.zeros(len(time), np.intp))], robot, LogOptions())


def test_a_bag_without_stops_is_refused_with_what_to_drive(tmp_path, capsys):
    bag = write_bag(tmp_path / "bag", *drive(seconds=60.0, stops=False))
    out = tmp_path / "none.safetensors"
    assert main(["import", str(bag), "--robot", str(FILE), "--out", str(out)]) == 1
    said = capsys.readouterr().err
    assert "no stops" in said and "set speed and turn rate to zero and let the robot stand for" in said
    assert not out.exists()


def test_the_report_says_what_is_missing_and_draws_it(tmp_path, figures):
    time, values = drive(seconds=200.0, seed=4)
    values[:, [3, 5]] *= 0.5  # never faster than 0.3 m/s
    values[:, 0] = np.cumsum(STEP * values[:, 3] * np.cos(values[:, 2]))
    values[:, 1] = np.cumsum(STEP * values[:, 3] * np.sin(values[:, 2]))
    path = write_csv(tmp_path / "slow.csv", time, values)
    out, picture = tmp_path / "a.safetensors", tmp_path / "a.png"
    said = figures("import", path, "--robot", FILE, "--out", out, "--picture", picture)
    missing = said["coverage"]["missing"]
    assert "speed never above 0.3 m/s (bound 0.6): record this" in missing
    assert any(text.startswith("no braking above 0.3 m/s of speed") for text in missing), missing
    (few,) = (text for text in missing if "plans of 5 periods that do not overlap" in text)
    assert few.startswith("at most 199 plans") and "the limit is 1 %: record 5 more minutes like these" in few
    assert picture.read_bytes().startswith(b"\x89PNG") and said["coverage"]["stops"] > 5
    assert Dataset.load(out).digest() == said["digest"]


def test_excitation_fills_what_is_missing_and_stays_inside(capsys):
    assert main(["excite", str(FILE), "--keep", "-1.5", "-1", "1.5", "1", "--minutes", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "time,run,speed,turn rate"
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    assert len(np.unique(rows[:, 1])) == 3 and rows[:, 2].max() == 0.6 and abs(rows[:, 3]).max() == 1.5
    for run in np.unique(rows[:, 1]):
        robot = Porter(np.random.default_rng(0))
        way = [robot.step(u, 0.2) for u in rows[rows[:, 1] == run, 2:]]
        assert (np.abs(np.concatenate(way)) < [1.5, 1.0]).all(), "in a simulator that has a lag"


def test_the_driving_of_a_single_joint_is_drawn_over_the_time(tmp_path):
    """It has no second coordinate to draw it against: the command ended with a traceback, and imported nothing."""
    joint = {
        "name": "joint",
        "period": 0.1,
        "state": {"angle": {"unit": "rad", "error": 0.0}},
        "input": {"rate": {"unit": "rad/s", "low": -0.5, "high": 0.5}},
        "limit": [{"name": "end", "weights": {"angle": 1.0}, "most": 1.0}],
        "plan": {"horizon": 4, "brake": 1},
    }
    still = Trajectory(np.zeros((61, 1)), np.zeros((60, 1)), np.zeros((60, 2, 1)), np.zeros(60))
    data = Dataset(robot_from_description(joint), (still,))
    draw_coverage(data, coverage(data), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
