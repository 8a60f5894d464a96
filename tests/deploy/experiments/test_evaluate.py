"""Evaluations: a batch counts the same episodes as one robot after the other, each once; a fleet shares a world."""

from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments import batch_evaluation
from brakeline.deploy.experiments.evaluate import Evaluation, EvaluationPart, evaluate, parts_of
from brakeline.deploy.run.replay_run import _joint_requests
from brakeline.logs.episode_stats import EpisodeStats
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND

TRAINED = Evaluation(policy="trained", arena="dense", episodes=6, model_config=ModelConfig(mode="direct"))
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
    version = model_for(GROUND, what.model_config).version
    for figures in (single, batch):
        assert figures["model"] == (version if method == "ddpc" else None)
        rows = figures["by_episode"]
        assert {len(column) for column in rows.values()} == {6}
        assert sum(rows["goal"]) == figures["goals"] and sum(rows["steps"]) == figures["steps"]
        assert sum(rows["interventions"]) == figures["interventions"]
    assert batch["by_episode"]["goal"] == single["by_episode"]["goal"], "the same episodes in the same order"
    assert batch["by_episode"]["steps"] == pytest.approx(single["by_episode"]["steps"], abs=2)


def test_each_episode_counts_once_however_many_robots_drive(data_folder, monkeypatch):
    """A robot's first goals come early. Only counting all episodes, the slow ones too, is fair to a policy."""
    returns = []
    for turns in (1, 3):
        monkeypatch.setattr(batch_evaluation, "TURNS", turns)
        ended: list[EpisodeStats] = []
        (part,) = parts_of(GROUND, replace(TRAINED, method="none", backend="batch"))
        driven = part.drive(ended.append)
        assert len(ended) == 6 and len(driven.stats) == 6 // turns
        returns.append(sorted(value for stats in driven.stats.values() for value in stats.returns))
    assert returns[1] == pytest.approx(returns[0], abs=1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"policy": "astar", "backend": "batch"}, "driven by a network"),
        ({"policy": "agent.py:Agent", "backend": "batch"}, "driven by a network"),
        ({"fleet": 3, "backend": "batch"}, "robots of a fleet"),
        ({"arena": "walkers", "method": "none", "backend": "batch"}, "moving obstacles"),
        ({"arena": "crossing", "method": "secas", "fleet": 2}, "reserves no space"),
        ({"arena": "crossing", "method": "sailr", "fleet": 2}, "reserves no space"),
    ],
)
def test_what_no_batch_and_no_fleet_does_is_refused(monkeypatch, change, said):
    monkeypatch.setattr(batch_evaluation, "method_for", lambda *_: object())
    with pytest.raises(ValueError, match=said):
        evaluate(GROUND, replace(TRAINED, **change))


def test_a_fleet_of_planners_gets_past_each_other(data_folder):
    figures = evaluate(GROUND, Evaluation("astar", arena="crossing", episodes=3, fleet=3))
    assert figures["fleet"] == 3 and figures["episodes"] == 3
    assert figures["goals"] == 3 and figures["collisions"] == figures["contacts_robots"] == 0
    assert set(figures["actors"]) == {"evaluate.0", "evaluate.1", "evaluate.2"}
    assert figures["robots"]["ground"]["steps"] == sum(one["steps"] for one in figures["actors"].values())
    worlds = figures["worlds"]
    assert worlds["count"] == 1 and worlds["touches"] == 0 and worlds["goals_per_minute"] > 0.0
    assert worlds["robot_steps"] >= figures["steps"], "who is at its goal stands there until the others are"


def test_what_was_one_question_is_asked_again_as_one():
    def one(actor, step, run=1):
        request = pb.Request(actor=actor, step=step, fleet=["a", "b"])
        return pb.Exchange(header=pb.Header(run=run), request=request, reply=pb.Reply())

    waiting = {}
    assert _joint_requests(waiting, one("b", 1)) == [] == _joint_requests(waiting, one("a", 2))
    asked = _joint_requests(waiting, one("a", 1))
    assert [request.actor for request, _ in asked] == ["a", "b"] and {request.step for request, _ in asked} == {1}
    assert _joint_requests(waiting, one("b", 2, run=2)) == [], "of another start of the process"
    assert len(_joint_requests(waiting, one("b", 2))) == 2 and len(waiting) == 1
    alone = pb.Exchange(request=pb.Request(actor="a"), reply=pb.Reply())
    assert _joint_requests(waiting, alone) == [(alone.request, alone.reply)]


@pytest.mark.parametrize("change", [{"episodes": 0}, {"seed": -1}, {"fleet": -2}])
def test_an_evaluation_of_nothing_is_refused(change):
    with pytest.raises(ValueError, match="at least 1 episode"):
        replace(TRAINED, **change)


@pytest.mark.parametrize("name", ["trained", "untrained", "astar"])
def test_a_file_that_is_called_like_a_policy_is_not_sent_to_the_workers(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(b"another policy")
    assert all(part.policy_file is None for part in parts_of(GROUND, replace(TRAINED, policy=name)))
    (part,) = parts_of(GROUND, replace(TRAINED, policy=f"./{name}"))
    assert part.policy_file == b"another policy", "a path names the file"


@pytest.mark.parametrize("name", [".", "..", "inputs.csv"])
def test_a_worker_gets_the_policy_of_the_folder_in_which_the_command_runs(tmp_path, monkeypatch, name):
    (tmp_path / "learner" / "checkpoint").mkdir(parents=True)
    (tmp_path / "learner" / "policy.safetensors").write_bytes(b"a policy")
    (tmp_path / "inputs.csv").write_bytes(b"a policy")
    monkeypatch.chdir(tmp_path / "learner" if name == ".." else tmp_path)
    monkeypatch.setattr(EvaluationPart, "drive", lambda part, each: Path(part.evaluation.policy))
    (part,) = parts_of(GROUND, replace(TRAINED, policy=name))
    policy = part.run(tmp_path / "worker", print)
    assert policy.read_bytes() == b"a policy" and policy.suffix == Path(name).suffix
