"""An evaluation in a batch counts the same episodes as one robot after the other, each once."""

from dataclasses import replace

import pytest

from brakeline.deploy.experiments import batch_evaluation
from brakeline.deploy.experiments.evaluate import Evaluation, EvaluationPart, evaluate, parts_of
from brakeline.errors import NoBatch
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.model_set import ModelConfig

GROUND = robot_with_task("ground")
TRAINED = Evaluation(policy="trained", arena="dense", episodes=12, model_config=ModelConfig(mode="direct"))
COUNTED = ("episodes", "goals", "collisions", "timeouts")


@pytest.mark.parametrize("method", ["ddpc", "none"])
def test_the_figures_are_those_of_one_robot_after_the_other(data_folder, method):
    what = replace(TRAINED, method=method)
    single, batch = evaluate(GROUND, what), evaluate(GROUND, replace(what, backend="batch"))
    assert {name: batch[name] for name in COUNTED} == {name: single[name] for name in COUNTED}
    assert batch["steps"] == pytest.approx(single["steps"], rel=0.01)
    assert batch["interventions"] == pytest.approx(single["interventions"], rel=0.05, abs=5)
    assert batch["mean_reward"] == pytest.approx(single["mean_reward"], rel=0.01)
    assert batch["closest_approach"] == pytest.approx(single["closest_approach"], abs=1e-3)
    assert (batch["collisions"] > 0) == (method == "none"), "what the filter prevents"
    assert batch["containment"]["steps"] == (batch["steps"] if method == "ddpc" else 0)


def test_each_episode_counts_once_however_many_robots_drive(data_folder, monkeypatch):
    """A robot's first goals come early. Only counting all episodes, the slow ones too, is fair to a policy."""
    found = []
    for turns in (1, 6):
        monkeypatch.setattr(batch_evaluation, "TURNS", turns)
        ended: list[EpisodeStats] = []
        (part,) = parts_of(GROUND, replace(TRAINED, method="none", backend="batch"))
        driven = part.drive(ended.append)
        assert len(ended) == 12 and len(driven.stats) == 12 // turns
        found.append(sorted(value for stats in driven.stats.values() for value in stats.returns))
    assert found[1] == pytest.approx(found[0], abs=1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"policy": "astar"}, "driven by a network"),
        ({"fleet": 3}, "robots of a fleet"),
        ({"arena": "walkers"}, "moving obstacles"),
    ],
)
def test_what_no_batch_simulates_is_refused(data_folder, monkeypatch, change, said):
    monkeypatch.setattr(batch_evaluation, "method_for", lambda *_: object())
    what = replace(TRAINED, backend="batch", **change)
    if change.keys() & {"arena"}:
        what = replace(what, method="none")
    with pytest.raises(NoBatch, match=said):
        EvaluationPart(GROUND, what, 0, 4, None).drive(lambda stats: None)
