"""The environments are registered with Gymnasium, with the options of their tasks and render modes."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import brakeline.envs  # noqa: F401  registers


@pytest.mark.parametrize(("name", "observation"), [("brakeline/Ground-v0", 26), ("brakeline/Quadrotor-v0", 189)])
def test_an_environment_is_made_by_its_name(name, observation):
    with gymnasium.make(name, arena="dense", render_mode="rgb_array") as env:
        first, info = env.reset(seed=0)
        assert first.shape == (observation,) and "state" in info
        env.step(env.action_space.sample())
        picture = env.render()
    assert isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 2, "something is drawn"


def test_an_arena_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="default"):
        gymnasium.make("brakeline/Ground-v0", arena="nowhere").reset(seed=0)


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium, brakeline; gymnasium.make('brakeline/Ground-v0')",
        "import gymnasium; gymnasium.make('brakeline.envs:brakeline/Quadrotor-v0')",
    ],
)
def test_a_program_registers_them_by_an_import(code):
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
