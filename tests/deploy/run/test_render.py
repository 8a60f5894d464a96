"""Pictures and films of an episode: their content, and every file format."""

import numpy as np
import pytest
from PIL import Image

from brakeline.deploy.experiments.evaluate import Evaluation, prepare_evaluation
from brakeline.deploy.run.episode_render import Film, record, save
from brakeline.logs.viewer import rgb_color
from tests.robots import GROUND


@pytest.fixture(scope="module")
def film(data_folder) -> Film:
    driver, policy, ask = prepare_evaluation(GROUND, Evaluation(policy="greedy", episodes=1))
    whole = record(driver, policy, ask, 0)
    return Film(whole.robot, whole.arena, whole.frames[:12], whole.frames[12].position, "cut")


def test_the_frames_are_what_was_decided(film):
    assert {frame.kind for frame in film.frames} <= {"allowed", "adjusted", "failsafe"}
    for frame, after in zip(film.frames, film.frames[1:], strict=False):
        low, high = frame.boxes
        assert low.shape == high.shape == (GROUND.horizon, 2) and (high > low).all()
        assert (after.position > low[0]).all() and (after.position < high[0]).all(), "the tube holds"


def test_without_a_filter_there_is_no_tube(data_folder):
    driver, policy, ask = prepare_evaluation(GROUND, Evaluation(policy="greedy", method="none"))
    recorded = record(driver, policy, ask, 1)
    assert recorded.frames[0].kind == "no filter" and len(recorded.frames[0].view.centers) == 0
    assert recorded.end in ("goal", "collision", "out of time")


def test_a_picture_shows_the_way_in_the_decisions_colours(film, tmp_path):
    save([film], tmp_path / "deep" / "way.png")
    pixels = np.asarray(Image.open(tmp_path / "deep" / "way.png").convert("RGB"), int)
    blue = (np.abs(pixels - rgb_color("allowed")).sum(-1) < 40).sum()
    green = (np.abs(pixels - rgb_color("goal")).sum(-1) < 40).sum()
    assert pixels.shape[0] > 500 and blue > 20 and green > 20


def test_moving_pictures_have_a_frame_a_period(film, tmp_path):
    save([film], tmp_path / "way.gif")
    with Image.open(tmp_path / "way.gif") as gif:
        assert gif.n_frames >= 12
        first = np.asarray(gif.convert("L"), int)
        gif.seek(11)
        assert np.abs(np.asarray(gif.convert("L"), int) - first).max() > 50, "it moves"
    save([film], tmp_path / "way.mp4")
    assert (tmp_path / "way.mp4").read_bytes()[4:8] == b"ftyp"


def test_another_ending_is_refused_with_those_there_are(film, tmp_path):
    with pytest.raises(ValueError, match=r"\.png, \.gif, \.mp4"):
        save([film], tmp_path / "way.bmp")


def test_two_films_side_by_side_last_as_long_as_the_longer(film, tmp_path):
    short = Film(film.robot, film.arena, film.frames[:5], film.frames[5].position, "collision")
    save([film, short], tmp_path / "beside.gif")
    with Image.open(tmp_path / "beside.gif") as gif:
        width, height = gif.size
        assert gif.n_frames >= 12 and width > 1.5 * height
