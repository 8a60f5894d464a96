"""How far the discs of a turning body leave their chords: by their own paths, where a recording has the headings."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.windows import ways
from tests.safety.test_turning_in_place import LONG, ROBOT

LONG_ROBOT = replace(ROBOT, name="long", body=LONG)
ARM = max(disc.arm for disc in LONG)


def turning(samples, turn=0.3, speed=0.1):
    """One period of an even turn at an even speed, in `samples` samples."""
    at = np.arange(1, samples + 1) / samples
    radius = speed / turn
    path = np.column_stack([radius * np.sin(at * turn), radius * (1.0 - np.cos(at * turn))])
    states = np.zeros((2, 5))
    states[1, :3] = *path[-1], turn
    return Trajectory(states, np.zeros((1, 2)), path[None], np.array([turn]), None, (at * turn)[None])


def test_an_even_turn_leaves_the_chord_by_little_more_than_its_sagitta():
    off = ways(LONG_ROBOT, turning(100))[0][0]
    farthest = (ARM + 0.1 / 0.3) * (1.0 - np.cos(0.15))  # no disc is farther from the center of the turn
    assert off < farthest + ARM * 0.3 / 100 + 1e-6
    unknown = replace(turning(100), headings=None)
    assert ways(LONG_ROBOT, unknown)[0][0] > 3.0 * off


def test_one_sample_a_period_says_nothing_about_the_time_of_the_turn():
    assert ways(LONG_ROBOT, turning(1))[0][0] == pytest.approx(ARM * 0.3)


def test_no_point_of_a_disc_is_farther_from_its_chord_than_stated():
    fine, coarse = turning(1000), turning(10)
    stated = ways(LONG_ROBOT, coarse)[0][0]
    for disc in LONG:
        cos, sin = np.cos(fine.headings[0]), np.sin(fine.headings[0])
        x, y = disc.at
        path = fine.paths[0] + np.column_stack([cos * x - sin * y, sin * x + cos * y])
        begin, chord = np.asarray(disc.at), path[-1] - np.asarray(disc.at)
        along = np.clip((path - begin) @ chord / (chord @ chord), 0.0, 1.0)
        assert np.linalg.norm(path - begin - along[:, None] * chord, axis=1).max() <= stated


def test_a_data_set_keeps_the_headings(tmp_path):
    data = Dataset(LONG_ROBOT, (turning(10), turning(10)))
    data.save(tmp_path / "d.safetensors")
    assert (Dataset.load(tmp_path / "d.safetensors").trajectories[1].headings == turning(10).headings).all()
