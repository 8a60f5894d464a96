"""A filter refuses a model set of an earlier description, if it is told today's."""

from dataclasses import replace

import pytest

from brakeline.errors import BadModel, TooLoose
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import ModelSet
from tests.robots import GROUND


@pytest.fixture
def mine(model: ModelSet) -> ModelSet:
    """The model set of a robot that does not come with Brakeline."""
    return replace(model, robot=robot_from_description(GROUND.description | {"name": "mine"}))


def test_a_robot_that_has_become_wider_is_not_filtered_as_the_one_before(mine, tmp_path):
    """A body of 30 cm touched a cylinder 40 cm ahead, and driving at it was allowed: the file's description counted."""
    path = tmp_path / "mine.safetensors"
    mine.save(path)
    wider = robot_from_description(mine.robot.description | {"body": [{"at": [0.0, 0.0], "radius": 0.30}]})
    assert Filter.load(path, mine.robot, accept_bound=1.0).robot.body == mine.robot.body
    with pytest.raises(BadModel, match=r"another description of mine than mine is now.*certify mine --use"):
        Filter.load(path, wider, accept_bound=1.0)
    with pytest.raises(BadModel, match="another description of mine than quadrotor is now"):
        Filter.load(path, "quadrotor", accept_bound=1.0)


def test_the_limit_of_todays_description_counts(mine, tmp_path):
    path = tmp_path / "mine.safetensors"
    replace(mine, about=mine.about | {"bound_plan": "0.2"}).save(path)
    accepting = robot_from_description(mine.robot.description | {"accept_bound": 0.3})
    assert Filter.load(path, accepting).robot.accept_bound == 0.3
    with pytest.raises(TooLoose):
        Filter.load(path, mine.robot)


def test_the_shipped_model_sets_are_of_the_shipped_descriptions():
    assert (
        Filter.load("ground", "ground").robot
        == Filter.load("ground", "ground-late").robot
        == ModelSet.load("ground").robot
    )
