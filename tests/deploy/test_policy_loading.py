"""A policy by the folder of the run that trained it."""

import numpy as np
import pytest

from brakeline.deploy.policy_loading import file_named, network_named, policy_hash
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import robot_with_task

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
