"""Several tasks of one robot in one process do not affect each other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadRequest, BadWeights, UnknownRobot
from brakeline.messaging.policy_weights import MLP, decode
from brakeline.messaging.robot import robot_named
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.filter.filter import Filter
from brakeline.safety.methods import Method
from brakeline.safety.methods import decode as read_model
from brakeline.safety.methods import ready as made_ready
from brakeline.safety.model.model_config import SECAS, ModelConfig
from brakeline.safety.rivals.pretrained import Pretrained
from tests.safety.asked import cylinder, request, same
from tests.safety.rivals.test_sailr import known

NAMES = ("ground", "ground+tracks")
OBSERVED = (26, 50)


def test_two_environments_observe_each_by_its_own_task_and_the_filter_decides_as_before(ready):
    sizes = (0, *OBSERVED)
    questions = [replace(request(obstacles=[cylinder(0.5, 0.0)]), observation=np.ones(n, np.float32)) for n in sizes]
    before = [ready.decide(question) for question in questions]
    environments = [environment(robot_with_task(name), "default", 0) for name in NAMES]
    for _ in range(2):
        for env, observed in zip(environments, OBSERVED, strict=True):
            seen, _ = env.reset(seed=1)
            assert seen.shape == env.observation_space.shape == (observed,)
            assert env.step(np.zeros(2))[0].shape == (observed,)
            for safety in (ready, Filter(ready.model)):
                assert all(map(same, map(safety.decide, questions), before))


def sailr(robot: RobotWithTask) -> Pretrained:
    """Return a rival that allows every proposal."""
    return known(threshold=1.0, robot=robot)


def test_two_rivals_read_each_the_observation_of_their_own_task():
    rivals: list[Method] = [made_ready(sailr(robot_with_task(name))) for name in NAMES]
    for rival, own in zip(rivals, OBSERVED, strict=True):
        for observed in OBSERVED:
            question = replace(request(), observation=np.zeros(observed, np.float32))
            if observed == own:
                assert rival.decide(question).kind == "allowed"
            else:
                with pytest.raises(BadRequest, match="observation has shape"):
                    rival.decide(question)


def test_rivals_of_two_tasks_lie_in_two_files_and_two_policies_are_read_each_by_its_own_task():
    usual, other = (robot_with_task(name) for name in NAMES)
    paths = [method_path(robot, SECAS, ModelConfig()) for robot in (usual, robot_named("ground"), other)]
    assert paths[0].name == paths[1].name and paths[0] != paths[2]
    for own, foreign in ((usual, other), (other, usual)):
        stored = MLP.untrained(own, 0).encode()
        assert decode(stored, own).robot == own
        with pytest.raises(BadWeights, match="layout"):
            decode(stored, foreign)


def test_a_robot_of_ones_own_is_read_from_the_models_file_and_from_nowhere_else(tmp_path: Path):
    text = (ROBOTS_FOLDER / "ground.toml").read_text().replace('name = "ground"', 'name = "minted"')
    (tmp_path / "my.toml").write_text(text)
    (tmp_path / "my.task.toml").write_text((ROBOTS_FOLDER / "ground.task.toml").read_text())
    payload = sailr(robot_with_task(str(tmp_path / "my.toml"))).encode()
    (tmp_path / "my.toml").unlink()
    with pytest.raises(UnknownRobot):
        robot_named("minted")
    assert read_model(payload).robot == replace(robot_named("ground"), name="minted")
