"""Studies on a Ray cluster: the results of local processes, also while a node of the cluster dies.

Ray is not among the packages of development: `pip install 'brakeline[ray]'` brings it, else these tests skip by name.
"""

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from brakeline.deploy.experiments.evaluate import Evaluation, evaluate, evaluate_with
from brakeline.deploy.experiments.experiment_jobs import complete, configuration
from brakeline.deploy.experiments.ray_tasks import write_files
from brakeline.deploy.experiments.task_engine import Engine
from brakeline.errors import NoCluster
from tests.robots import GROUND
from tests.waiting import until

MEASURED = {"decision_ms", "propose_ms"}  # times differ from run to run


def test_a_file_never_leaves_its_folder(tmp_path):
    write_files(tmp_path / "run", {"a/b.txt": b"1"})
    assert (tmp_path / "run" / "a" / "b.txt").read_bytes() == b"1"
    for name in ("../c.txt", "/tmp/c.txt", "a/../../c.txt"):
        with pytest.raises(ValueError, match="leads out"):
            write_files(tmp_path / "run", {name: b"1"})
    assert not (tmp_path / "c.txt").exists()


def test_parts_give_the_figures_of_the_whole_whoever_runs_them(monkeypatch):
    monkeypatch.setattr("brakeline.deploy.experiments.evaluate.EPISODES_A_PART", 2)
    what, said = Evaluation("greedy", episodes=3), []
    here = evaluate(GROUND, what)
    there = evaluate_with(Engine(2), GROUND, what, lambda name, text: said.append(name))
    assert {k: v for k, v in here.items() if k not in MEASURED} == {k: v for k, v in there.items() if k not in MEASURED}
    assert here["episodes"] == 3
    assert set(said) == {"episodes from 0", "episodes from 2"}


@dataclass(frozen=True)
class Slow:
    """A job that notes each of its starts in a folder, and takes a while."""

    number: int
    marks: str
    seconds: float = 3.0
    robot: str = "ground"

    @property
    def name(self):
        return f"slow-{self.number}"

    def run(self, folder, say):
        Path(self.marks, f"{self.number}-{os.getpid()}").touch()
        time.sleep(self.seconds)
        if self.number < 0:
            raise ValueError("no such number")
        folder.mkdir(parents=True)
        (folder / "log.txt").write_text(f"{self.number}")
        say("nearly done")
        return {"study": configuration(self), "number": self.number}


@pytest.fixture
def cluster(monkeypatch):
    """A cluster on this machine: a head without processors, and two nodes."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'brakeline[ray]'")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    made.nodes = [made.add_node(num_cpus=1), made.add_node(num_cpus=1)]
    yield made
    made.shutdown()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_dead_node_loses_nothing_and_nothing_counts_twice(cluster, tmp_path):
    (marks := tmp_path / "marks").mkdir()
    jobs, results = [Slow(n, str(marks)) for n in range(6)], tmp_path / "results"

    def kill():
        until(lambda: len(list(marks.iterdir())) >= 2, "two jobs run", 60.0)
        cluster.remove_node(cluster.nodes[0], allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    found = complete(jobs, results, tmp_path / "runs", Engine(ray=cluster.address))
    killer.join()
    assert [one["number"] for one in found] == list(range(6))
    assert len(list(marks.iterdir())) > 6, "a job ran again, on the node that was left"
    assert sorted(path.name for path in (results / "ground").iterdir()) == [f"slow-{n}.json" for n in range(6)]
    assert [(tmp_path / "runs" / "ground" / f"slow-{n}" / "log.txt").read_text() for n in range(6)] == list("012345")
    with pytest.raises(ValueError, match="no such number"):
        complete([Slow(-1, str(marks), 0.0), Slow(7, str(marks), 0.0)], results, tmp_path / "runs", Engine(ray="auto"))
    assert (results / "ground" / "slow-7.json").exists(), "the others go on"


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_an_evaluation_has_the_same_figures(cluster, monkeypatch):
    monkeypatch.setattr("brakeline.deploy.experiments.evaluate.EPISODES_A_PART", 2)
    what, said = Evaluation("trained", episodes=5), []
    here = evaluate(GROUND, what)
    there = evaluate_with(Engine(ray=cluster.address), GROUND, what, lambda name, text: said.append(text))
    assert {k: v for k, v in here.items() if k not in MEASURED} == {k: v for k, v in there.items() if k not in MEASURED}
    assert any("goals" in text for text in said)


def test_without_a_cluster_the_error_says_how_to_start_one():
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'brakeline[ray]'")
    with pytest.raises(NoCluster, match="ray start --head"):
        evaluate_with(Engine(ray="127.0.0.1:9"), GROUND, Evaluation(episodes=1))
