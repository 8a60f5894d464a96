"""Test driven excitation: the robot stays in its region, and the log is data of the robot."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner
from brakeline.deploy.data.excitation_plan import RegionExcitation
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadData
from brakeline.logs.reader import read
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.windows import PLAN, windows
from tests.deploy.drive import episode
from tests.robots import GROUND

CAR = str(Path(__file__).parents[3] / "examples" / "car" / "car.toml")
KEEP = (-1.6, -1.4, 1.8, 1.4)


def test_a_car_is_driven_inside_the_region_and_its_log_is_imported(tmp_path, command, figures):
    """Its inputs do not tell where it turns to: only measuring keeps it inside."""
    log, data = tmp_path / "excited.mcap", tmp_path / "data.safetensors"
    words = ("excite", CAR, "--keep", *KEEP, "--minutes", 2, "--drive", log)
    said = figures(*words)
    steps = [record.message for record in read(log) if record.topic == "step"]
    assert len(steps) == said["periods"] == 600 and said["runs"] == 2 and said["collisions"] == 0
    robot = robot_with_task(CAR)
    truth = np.array([step.true_state for step in steps])
    for disc in robot.body:
        ahead = np.stack([np.cos(truth[:, 2]), np.sin(truth[:, 2])], 1) * disc.at[0]
        centre = truth[:, :2] + ahead
        assert (centre - disc.radius > KEEP[:2]).all() and (centre + disc.radius < KEEP[2:]).all()
    assert np.ptp(truth[:, :2], axis=0).min() > 0.8, "and yet it went about"
    assert command("import", log, "--robot", CAR, "--out", data)[0] == 0
    driven = Dataset.load(data)
    assert driven.periods > 580 and len(windows(driven, robot.horizon, PLAN)) > 60
    for again, reason in ((words, "is there already"), (("excite", CAR), "do not determine how it turns")):
        status, _, err = command(*again)
        assert status == 1 and reason in err


def test_a_robot_that_leaves_the_region_brakes_by_its_own_rule():
    policy = RegionExcitation(robot_with_task(CAR), KEEP, np.random.default_rng(0))
    at = {"time": 0.0, "state": np.zeros(5), "input_in_force": np.zeros(2)}
    policy(None, at)
    driven = np.array([0.4, 0.2])
    near = {"time": 0.2, "state": np.array([1.45, 0.0, 0.0, 0.4, 0.2]), "input_in_force": driven}
    assert policy(None, near).tolist() == [0.0, 0.2], "its steering is held"
    inwards = near | {"state": np.array([1.42, 0.0, np.pi, 0.4, 0.2])}
    policy._left = [driven]
    assert policy(None, inwards).tolist() == [0.4, 0.2]


def test_a_region_without_room_to_stop_is_refused():
    with pytest.raises(BadData, match="too small to stop in"):
        RegionExcitation(GROUND, (-0.2, -0.2, 0.2, 0.2), np.random.default_rng(0))


def test_printed_inputs_are_a_policy_of_any_actor(tmp_path):
    path = tmp_path / "inputs.csv"
    path.write_text("time,run,command speed,command turn rate\n0,0,0.1,0\n0.2,0,0.2,0.1\n0,1,0.05,-0.2\n")
    driver = EpisodeRunner(GROUND, environment(GROUND, "open", 0), ActorIdentity("test", 0, 0), filtered=False)
    policy = policy_named(str(path), GROUND, 0)
    driven = [[list(step.action) for step in islice(episode(driver, policy, None, n), 3)] for n in (0, 1)]
    assert np.allclose(driven[0], [(0.1, 0), (0.2, 0.1), (0, 0)])
    assert np.allclose(driven[1], [(0.05, -0.2), (0, 0), (0, 0)])
    path.write_text("time,command speed\n0,0.1\n")
    with pytest.raises(BadData, match="no column command turn rate; there are: command speed"):
        policy_named(str(path), GROUND, 0)
