"""Data sets are saved, checked and cut into windows."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brakeline.errors import BadData
from brakeline.messaging.obstacle import rotate
from brakeline.messaging.robot import Disc
from brakeline.safety.model.dataset import ENTRY, Dataset, Trajectory
from brakeline.safety.model.tensor_file import pack, unpack
from brakeline.safety.model.windows import check_regressors, displacement, non_overlapping, ways, windows
from tests.robots import GROUND
from tests.safety.unicycle import record

pytestmark = pytest.mark.fast


@pytest.fixture(scope="module")
def small() -> Dataset:
    return record(trajectories=4, periods=60)


def changed(data, **parts):
    """Return the data set with parts of its first trajectory replaced."""
    return replace(data, trajectories=(replace(data.trajectories[0], **parts), *data.trajectories[1:]))


def turning(samples, turn=0.3):
    """Return one period of 0.1 m with an even turn, in `samples` samples."""
    at, radius = np.arange(1, samples + 1) / samples, 0.1 / turn
    path = np.column_stack([radius * np.sin(at * turn), radius * (1.0 - np.cos(at * turn))])
    states = np.zeros((2, 5))
    states[1, :3] = *path[-1], turn
    return Trajectory(states, np.zeros((1, 2)), path[None], np.array([turn]), None, (at * turn)[None])


def with_value(array, value):
    array = array.copy()
    array[(3, 0)[: array.ndim]] = value
    return array


def test_a_saved_data_set_is_loaded_unchanged(small, tmp_path):
    path, moving = tmp_path / "deep" / "set.safetensors", changed(small, before=np.array([0.1, -0.2]))
    moving.save(path)
    again = Dataset.load(path)
    again.save(str(tmp_path / "named"))
    assert Dataset.load(str(tmp_path / "named")).digest() == again.digest() == moving.digest()
    assert again.about == small.about and again.periods == 240
    for one, other in zip(moving.trajectories, again.trajectories, strict=True):
        for name in ("states", "inputs", "paths", "turned"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
    assert np.array_equal(again.trajectories[0].before, [0.1, -0.2])
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["set.safetensors"]
    with_headings = Dataset(GROUND, (turning(10), turning(10)))
    with_headings.save(path)
    assert (Dataset.load(path).trajectories[1].headings == turning(10).headings).all()


@pytest.mark.parametrize("name", ["states", "inputs", "paths", "turned"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_are_refused(small, name, value):
    bad = changed(small, **{name: with_value(getattr(small.trajectories[0], name), value)})
    with pytest.raises(BadData, match=f"{name} holds NaN"):
        bad.check()


def test_wrong_sizes_bounds_and_boundaries_are_refused(small):
    t = small.trajectories[0]
    for parts in (
        {"states": t.states[:-1]},
        {"states": t.states[:, :4]},
        {"inputs": t.inputs[:, :1]},
        {"turned": t.turned[1:]},
        {"paths": t.paths[:, :, :1]},
        {"paths": t.paths[:, 0]},
        {"before": np.zeros(3)},
    ):
        with pytest.raises(BadData, match="shape"):
            changed(small, **parts).check()
    for parts in ({"inputs": with_value(t.inputs, -0.1)}, {"before": np.array([0.0, 0.7])}):
        with pytest.raises(BadData, match="out of the robot's bounds"):
            changed(small, **parts).check()
    for length in (-0.01, np.nan, np.inf):
        with pytest.raises(BadData, match=r"chord deviation .* is no length"):
            replace(small, chord_deviation=length).check()
    for check in (Dataset.check, lambda data: windows(data, 1)):
        with pytest.raises(BadData, match="no trajectory"):
            check(replace(small, trajectories=()))


def test_two_recordings_glued_into_one_are_refused(small):
    a, b = small.trajectories[:2]
    moved = b.states + np.array([1.0, 0.5, 0.0, 0.0, 0.0])
    glued = Trajectory(
        np.vstack([a.states[:-1], moved]),
        np.vstack([a.inputs, b.inputs]),
        np.concatenate([a.paths, b.paths]),
        np.concatenate([a.turned, b.turned]),
    )
    with pytest.raises(BadData, match=r"jumps in period 59"):
        replace(small, trajectories=(glued,)).check()


def test_files_that_hold_no_valid_data_set_are_refused(small, tmp_path):
    path = tmp_path / "set.safetensors"
    small.save(path)
    whole = path.read_bytes()
    for garbage in (b"", b"garbage", whole[:-100], whole[:50]):
        path.write_bytes(garbage)
        with pytest.raises(BadData, match="no data set"):
            Dataset.load(path)
    with pytest.raises(BadData):
        Dataset.load(tmp_path / "nowhere")
    path.write_bytes(whole)
    tensors, about = unpack(whole, ENTRY)
    assert (about["robot"], about["layout"], about["about"]) == ("ground", GROUND.layout(), small.about)
    assert json.loads(about["description"]) == GROUND.description
    ends = tensors["lengths"]
    for changes, metadata, message in (
        ({"lengths": ends + 1}, about, "do not add up"),
        ({"lengths": np.array([70, -10, *ends[2:], 60])}, about, "no lengths"),
        ({"lengths": ends.astype(float)}, about, "no lengths"),
        ({"paths": tensors["paths"][:-1]}, about, "do not add up"),
        ({"states": tensors["states"][:, :3]}, about, "shapes"),
        ({}, about | {"layout": "another"}, "layout"),
        ({}, about | {"robot": "submarine"}, "submarine"),
        ({}, {}, "missing"),
        ({}, about | {"robot": ["ground"]}, "robot"),
        ({}, about | {"about": "{"}, "no data set"),
    ):
        path.write_bytes(pack(tensors | changes, ENTRY, metadata))
        with pytest.raises(BadData, match=message):
            Dataset.load(path)
    del tensors["turned"]
    path.write_bytes(pack(tensors, ENTRY, about))
    with pytest.raises(BadData, match="turned is missing"):
        Dataset.load(path)


def test_poor_regressors_are_refused():
    rng = np.random.default_rng(0)
    good = rng.normal(size=(400, 3))
    assert check_regressors(good, "these").rank == 3
    with pytest.raises(BadData, match="at least 200 are needed: record more, or fit with mode one-step"):
        check_regressors(good[:50], "these")
    with pytest.raises(BadData, match="rank 2 of 3"):
        check_regressors(np.column_stack([good[:, :2], good[:, 0] + good[:, 1]]), "these")
    with pytest.raises(BadData, match="condition number"):
        check_regressors(np.column_stack([good[:, :2], good[:, 0] + 1e-5 * good[:, 2]]), "these")


def test_splitting_keeps_trajectories_whole(data):
    parts = data.split((0.7, 0.3))
    assert sum(len(p.trajectories) for p in parts) == len(data.trajectories)
    assert len(parts[0].trajectories) == pytest.approx(0.7 * len(data.trajectories), abs=2)
    ids = [id(t) for p in parts for t in p.trajectories]
    assert len(set(ids)) == len(data.trajectories)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_windows_are_plans_within_one_trajectory(small, k):
    columns = windows(changed(small, before=np.array([0.2, 0.1])), k)
    expected = []
    for number, t in enumerate(small.trajectories):
        starts = range(len(t.inputs) - k + 1)  # of one free input, then zero
        expected += [(number, start) for start in starts if not t.inputs[start + 1 : start + k].any()]
    assert [tuple(s) for s in columns.start] == expected
    for row, (number, start) in enumerate(expected):
        t = small.trajectories[number]
        first = [0.2, 0.1] if number == 0 else [0.0, 0.0]
        before = t.inputs[start - 1] if start else first
        assert np.array_equal(columns.z[row], [*t.states[start, 3:], *before, *t.inputs[start]])
        assert np.array_equal(columns.y[row, 3:], t.states[start + k, 3:])


def test_chord_deviation_and_stopping_distance_by_brute_force(small):
    columns = windows(small, 3)
    for row in range(0, len(columns), 7):
        number, start = columns.start[row]
        t = small.trajectories[number]
        path = np.vstack([np.zeros(2), t.paths[start + 2]])
        along = path[0] + np.linspace(0, 1, 4001)[:, None] * (path[-1] - path[0])
        brute = np.linalg.norm(path[:, None] - along[None], axis=2).min(1).max()
        assert columns.chord_deviation[row] == pytest.approx(brute, abs=1e-5)
        at, position, heading, farthest = start + 3, np.zeros(2), 0.0, np.nan
        while at < len(t.inputs) and not t.inputs[at].any():
            points = position + rotate(t.paths[at], heading)
            farthest = np.nanmax([farthest, np.linalg.norm(points, axis=1).max()])
            position, heading, at = points[-1], heading + t.turned[at], at + 1
        assert columns.stopping_distance[row] == pytest.approx(farthest, abs=1e-12, nan_ok=True)
    assert np.isnan(columns.stopping_distance).any()
    assert not np.isnan(columns.stopping_distance).all()


LONG = (Disc((0.12, 0.0), 0.1), Disc((0.0, 0.0), 0.15), Disc((-0.12, 0.0), 0.1))
ARM = max(disc.arm for disc in LONG)


def off_chord(trajectory):
    """Return how far the discs of a long robot leave their chords in a trajectory's first period."""
    return ways(replace(GROUND, body=LONG), trajectory)[0][0]


def test_discs_that_turn_leave_their_chords_by_little_more_than_the_sagitta_if_the_headings_are_known():
    farthest = (ARM + 0.1 / 0.3) * (1.0 - np.cos(0.15))  # no disc is farther from the center of the turn
    assert off_chord(turning(100)) < farthest + ARM * 0.3 / 100 + 1e-6
    assert off_chord(replace(turning(100), headings=None)) > 3.0 * off_chord(turning(100))
    assert off_chord(turning(1)) == pytest.approx(ARM * 0.3), "one sample says nothing about the time of the turn"


def test_no_point_of_a_disc_is_farther_from_its_chord_than_stated():
    fine = turning(1000)
    cos, sin = np.cos(fine.headings[0]), np.sin(fine.headings[0])
    for disc in LONG:
        x, y = disc.at
        path = fine.paths[0] + np.column_stack([cos * x - sin * y, sin * x + cos * y])
        begin, chord = np.asarray(disc.at), path[-1] - np.asarray(disc.at)
        along = np.clip((path - begin) @ chord / (chord @ chord), 0.0, 1.0)
        assert np.linalg.norm(path - begin - along[:, None] * chord, axis=1).max() <= off_chord(turning(10))


STATE = arrays(float, 5, elements=st.floats(-3, 3))


@settings(max_examples=100)
@given(STATE, STATE, st.floats(-10, 10), st.floats(-10, 10), st.floats(-4, 4))
def test_displacement_does_not_depend_on_the_pose_in_the_world(start, end, dx, dy, turn):
    measured = displacement(GROUND, start, end)

    def moved(state):
        out = state.copy()
        out[:2] = rotate(state[:2], turn) + np.array([dx, dy])
        out[2] += turn
        return out

    again = displacement(GROUND, moved(start), moved(end))
    again[2] = (again[2] - measured[2] + np.pi) % (2 * np.pi) - np.pi + measured[2]
    assert np.allclose(measured, again, atol=1e-9)
    assert -np.pi <= measured[2] < np.pi


def test_windows_apart_do_not_overlap(small):
    chosen = non_overlapping(windows(small, 3), 3)
    for one, other in zip(chosen.start, chosen.start[1:], strict=False):
        assert one[0] != other[0] or other[1] - one[1] >= 3
