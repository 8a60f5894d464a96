"""A policy by the folder of the run that trained it, and by a class in a file of your own."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.deploy.policy_loading import file_named, network_named, policy_hash, policy_named
from brakeline.errors import BadInput, UnknownTask
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import Scan
from brakeline.messaging.task import robot_with_task, with_task

GROUND = robot_with_task("ground")


@pytest.mark.parametrize("learner", ["learner", "learner-ground"])
def test_the_folder_of_a_run_stands_for_its_policy(tmp_path, learner):
    path = tmp_path / learner / "policy.safetensors"
    path.parent.mkdir()
    MLP.untrained(GROUND, 3).save(path)
    seen = np.zeros(MLP.load(path, GROUND).sizes[0], np.float32)
    assert np.array_equal(network_named(str(tmp_path), GROUND, 0)(seen), network_named(str(path), GROUND, 0)(seen))
    assert file_named(str(tmp_path), GROUND) == path
    assert policy_hash(str(tmp_path), GROUND) == policy_hash(str(path), GROUND)


def test_a_folder_without_a_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no policy of ground: name the folder of a training"):
        network_named(str(tmp_path), GROUND, 0)


ERASER = """
def erase(observation, info):
    info["scan"].ranges[:] = 3.5
    return [0.1, 0.2]
"""

AGENT = """
class Agent:
    def __init__(self, robot, generator):
        self.input = 0.5 * robot.high() + generator.uniform(0.0, 1e-3, robot.action_dim)

    def __call__(self, observation, info):
        return self.input

def steady(observation, info):
    return [0.1, 0.2]

def greedy(observation, info):
    observation *= 2.0
    info["state"][:] = 0.0
    while info["obstacles"]:
        info["obstacles"].pop()
    return [0.1, 0.2]

def alone():
    pass

class Alone:
    pass

class Silent:
    def __init__(self, robot, generator):
        pass
"""


TASK_AGENT = """
class Cheat:
    def __init__(self, robot, generator):
        pass

    def prepare(self, stage):
        self.stage = stage

    def __call__(self, observation, info):
        info["state"][:] = 0.0
        info["obstacles"].clear()
        return [0.1, 0.2]
"""


def test_a_class_or_a_function_in_a_file_of_your_own_is_a_policy(tmp_path, monkeypatch):
    (tmp_path / "agent.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    first, again, other = (
        policy_named(name, GROUND, seed)(None, {})
        for name, seed in (("agent.py:Agent", 3), (f"{tmp_path}/agent.py:Agent", 3), ("agent.py:Agent", 4))
    )
    assert np.allclose(first, 0.5 * GROUND.high(), atol=1e-3)
    assert policy_named("agent.py:steady", GROUND, 0)(None, {}).tolist() == [0.1, 0.2]
    assert np.array_equal(first, again) and not np.array_equal(first, other), "the seed decides"


def test_a_policy_of_your_own_that_overwrites_what_it_gets_changes_no_request(tmp_path, monkeypatch):
    """The filter decides with the same state and obstacles: an empty list means that all space is free."""
    (tmp_path / "agent.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    observation, info = np.ones(3, np.float32), {"state": np.ones(5), "obstacles": ["a post"]}
    policy_named("agent.py:greedy", GROUND, 0)(observation, info)
    assert observation.all() and observation.max() == 1.0
    assert info["state"].all() and info["obstacles"] == ["a post"]


def test_a_policy_of_your_own_that_overwrites_its_scan_frees_no_space(tmp_path, monkeypatch):
    (tmp_path / "eraser.py").write_text(ERASER)
    monkeypatch.chdir(tmp_path)
    scan = Scan(ranges=np.full(9, 0.4), angles=np.linspace(-1.0, 1.0, 9), pose=(0.0, 0.0, 0.0))
    image = RangeImage(np.full((20, 40), 0.4), (0.0, 0.0, 0.0))
    for sensed in (scan, image):
        policy_named("eraser.py:erase", GROUND, 0)(np.ones(3, np.float32), {"scan": sensed})
        assert sensed.ranges.max() == 0.4


def test_neither_does_a_policy_that_a_task_names(tmp_path):
    (tmp_path / "task_agent.py").write_text(TASK_AGENT)
    policies = {"cheat": "task_agent.py:Cheat"}
    mine = with_task(GROUND, replace(GROUND.task, folder=tmp_path, policies=policies))
    policy, info = policy_named("cheat", mine, 0), {"state": np.ones(5), "obstacles": ["a post"]}
    policy(np.ones(3, np.float32), info)
    assert info["state"].all() and info["obstacles"] == ["a post"]
    policy.prepare("stage")
    assert policy.prepare.__self__.stage == "stage", "a flight prepares it"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("agent.py:Alone", r"cannot be called with \(robot, generator\)"),
        ("agent.py:alone", r"is no function of \(observation, info\)"),
        ("agent.py:Silent", "define __call__"),
        ("agent.py:Nobody", "agent.py has no 'Nobody'"),
        ("gone.py:Agent", "no code that can be loaded"),
    ],
)
def test_code_that_makes_no_policy_is_refused(tmp_path, monkeypatch, name, said):
    (tmp_path / "agent.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UnknownTask, match=said):
        policy_named(name, GROUND, 0)


def test_anything_but_an_input_is_refused(tmp_path, monkeypatch):
    (tmp_path / "agent.py").write_text(AGENT.replace("return self.input", "return [*self.input, 0.0]"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInput, match=r"shape \(3,\): return 2 numbers \(speed \[m/s\], turn rate \[rad/s\]\)"):
        policy_named("agent.py:Agent", GROUND, 0)(None, {})
