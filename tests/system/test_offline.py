"""Test that a policy from a log alone does better than chance. Takes half an hour on two cores."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.deploy.experiments.evaluate import Evaluation, evaluate
from brakeline.logs.episode_stats import EpisodeStats
from tests.robots import GROUND
from tests.system.runs import succeeded

STEPS = 25_000
EPISODES = 200
HOUR = 3600.0


def returns(policy: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the rewards of fresh episodes behind the filter."""
    found: list[float] = []

    def each(tally: EpisodeStats) -> None:
        found.append(tally.returns[-1])

    evaluate(GROUND, Evaluation(policy=policy, episodes=EPISODES), each)
    return np.array(found)


@pytest.mark.long
@pytest.mark.timeout(HOUR)
def test_offline_training_beats_chance(data_folder: Path, tmp_path: Path) -> None:
    succeeded("train", "ground", "--steps", STEPS, "--out", tmp_path / "run", "--json", timeout=HOUR)
    words = ("train", "ground", "--from-logs", tmp_path / "run", "--actors", 0)
    succeeded(*words, "--out", tmp_path / "offline", "--json", timeout=HOUR)
    learned = returns(str(tmp_path / "offline" / "learner" / "policy.safetensors"))
    chance = returns("random")
    difference = learned.mean() - chance.mean()
    deviation = np.sqrt(learned.var(ddof=1) / len(learned) + chance.var(ddof=1) / len(chance))
    assert difference - 1.96 * deviation > 0.0, f"{difference:.1f} ± {1.96 * deviation:.1f}"
