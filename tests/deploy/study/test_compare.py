"""The comparison: jobs that are skipped, refused, resumed; figures by hand; and the same seed twice."""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest

from deploy.data import pretrain, store
from deploy.study.cells import METHODS, Study, Trial, quick, run
from deploy.study.compare import Cell, OtherConfiguration, complete, read, studies, write
from deploy.study.curves import learning_curves, seeds_as_points
from deploy.study.intervals import mean, ratio
from deploy.study.table import markdown, plain, steps_to_learn, table, without_times
from learner.pretrain import Fit
from logs.report import analyse
from messaging.tasks import learnt
from messaging.weights import MLP
from safety.model_set import Recipe
from tests.robots import GROUND
from tests.system.runs import until

DEAR = ("decision_ms", "milliseconds")


@dataclass(frozen=True)
class Errand:
    """A job that leaves a mark where it was done."""

    number: int
    setting: int = 0
    robot: str = "ground"

    @property
    def name(self) -> str:
        return f"errand-{self.number}"

    def config(self) -> dict:
        return {"number": self.number, "setting": self.setting}

    def run(self, folder: Path, say) -> dict:
        if self.number < 0:
            raise RuntimeError("no such number")
        folder.mkdir(parents=True)
        say("half way")
        return {"study": self.config(), "square": self.number**2}


def test_what_is_there_is_not_run_again(tmp_path):
    jobs, told = [Errand(n) for n in (1, 2, 3)], []
    write(tmp_path / "results", jobs[1], {"study": jobs[1].config(), "square": -1})
    say = lambda name, text: told.append((name, text))  # noqa: E731
    found = complete(jobs, tmp_path / "results", tmp_path / "runs", workers=1, say=say)
    assert [result["square"] for result in found] == [1, -1, 9]
    assert told == [("errand-1", "half way"), ("errand-3", "half way")]
    assert complete(jobs, tmp_path / "results", tmp_path / "elsewhere", workers=2) == found
    assert not (tmp_path / "elsewhere").exists(), "the results alone suffice, on any machine"
    assert read(tmp_path / "results", Errand(4)) is None


def test_side_by_side_they_give_the_same(tmp_path):
    jobs = [Errand(n) for n in range(5)]
    found = complete(jobs, tmp_path / "results", tmp_path / "runs", workers=2)
    assert [result["square"] for result in found] == [0, 1, 4, 9, 16]
    assert len(list((tmp_path / "results" / "ground").iterdir())) == 5


@dataclass(frozen=True)
class Nap(Errand):
    """A job that says which process does it, and does not end."""

    def run(self, folder: Path, say) -> dict:
        folder.mkdir(parents=True)
        write(folder, Errand(self.number), {"pid": os.getpid()})
        time.sleep(600.0)
        return {}


NAPS = """
from pathlib import Path
from deploy.study.compare import complete
from tests.deploy.study.test_compare import Nap
if __name__ == "__main__":
    complete([Nap(1), Nap(2)], Path({0!r}) / "results", Path({0!r}) / "runs", workers=2)
"""


def test_killed_it_leaves_no_worker_behind(tmp_path):
    (tmp_path / "naps.py").write_text(NAPS.format(str(tmp_path)))
    root = Path(__file__).parents[3]
    popen = subprocess.Popen([sys.executable, tmp_path / "naps.py"], env=os.environ | {"PYTHONPATH": str(root)})
    marks = [tmp_path / "runs" / "ground" / f"errand-{n}" / "ground" / f"errand-{n}.json" for n in (1, 2)]
    until(lambda: all(mark.exists() for mark in marks), "both are at work")
    workers = {json.loads(mark.read_text())["pid"] for mark in marks}
    children = psutil.Process(popen.pid).children(recursive=True)
    assert workers <= {child.pid for child in children}
    popen.kill()
    popen.wait()
    until(lambda: not any(child.is_running() for child in children), "all have ended", 10.0)


def test_a_job_that_fails_loses_nothing_that_was_done(tmp_path):
    jobs = [Errand(1), Errand(-1), Errand(2)]
    with pytest.raises(RuntimeError, match="no such number"):
        complete(jobs, tmp_path / "results", tmp_path / "runs", workers=2)
    assert read(tmp_path / "results", jobs[0]) is not None


def test_a_result_of_other_settings_is_refused_unless_it_shall_be_run_again(tmp_path):
    complete([Errand(1)], tmp_path / "results", tmp_path / "runs", workers=1)
    with pytest.raises(OtherConfiguration, match="another setting") as refused:
        complete([Errand(2), Errand(1, setting=5)], tmp_path / "results", tmp_path / "other", workers=1)
    assert "errand-1.json" in str(refused.value)
    assert not (tmp_path / "other").exists(), "nothing is run before everything was looked at"
    complete([Errand(1, setting=5)], tmp_path / "results", tmp_path / "again", workers=1, again=True)
    assert read(tmp_path / "results", Errand(1, setting=5)) is not None


# --- studies -------------------------------------------------------------------------------------------------------

TINY = Study("ground", "none", 3, steps=640, episodes=1, arenas=("default",), untrained=1)
TINY = replace(TINY, td3=replace(TINY.td3, hidden=(16, 16), batch=16, warmup=60))


@pytest.fixture(scope="module")
def rivals(data_folder):
    """Rivals that know next to nothing, made in seconds."""
    little = {"samples": 300, "fit": Fit(hidden=(8, 8), epochs=1, batch=32)}
    made = {"secas": partial(pretrain.SecasRecipe, **little), "sailr": partial(pretrain.SailrRecipe, **little)}
    before = dict(pretrain.RECIPES)
    pretrain.RECIPES.update(made)
    for method in made:
        store.method_for(GROUND, method, Recipe())
    yield made
    pretrain.RECIPES.update(before)


@pytest.fixture(scope="module")
def cells(rivals, tmp_path_factory) -> dict[str, dict]:
    folder = tmp_path_factory.mktemp("cells")
    return {m: run(replace(TINY, method=m), folder / m) | {"folder": folder / m} for m in METHODS}


def stripped(value):
    """Without anything that a clock had a part in."""
    if isinstance(value, dict):
        return {k: stripped(v) for k, v in value.items() if k not in (*DEAR, "folder", "seconds")}
    return value


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_cell_and_another_seed_another(cells, method, tmp_path):
    again = run(replace(TINY, method=method), tmp_path / "again")
    assert stripped(again) == stripped(cells[method])
    if method == "none":
        assert run(replace(TINY, seed=4), tmp_path / "other")["policy"] != again["policy"]


@pytest.mark.parametrize("method", METHODS)
def test_a_cell_says_what_its_logs_say(cells, method):
    cell, found = cells[method], None
    for name, evaluation in [("training", cell["training"]), *cell["evaluations"].items()]:
        found = analyse(cell["folder"] / f"{name}.mcap")
        episodes = evaluation["episodes"]
        assert found["episodes"] == len(episodes["goal"]) and found["goals"] == sum(episodes["goal"])
        assert sum(episodes["steps"]) <= found["steps"]
        assert found["mean_reward"] == pytest.approx(np.mean(episodes["reward"]), abs=1e-3)
        assert found["seed"] == TINY.seed and found["method"] == (method if name == "training" else name.split("-")[1])
    assert cell["training"]["steps"] == TINY.steps and cell["training"]["updates"] == TINY.steps - TINY.td3.warmup
    assert json.loads(json.dumps(cell["study"])) == replace(TINY, method=method).config()
    assert MLP.load(cell["folder"] / "policy.safetensors", GROUND).sizes == (26, 16, 16, 2)


def test_methods_share_the_episodes_that_they_are_evaluated_on(cells):
    from logs.reader import read as records

    arenas = []
    for method in METHODS:
        log = cells[method]["folder"] / f"trained-{method}-default.mcap"
        arenas.append([(r.message.start, r.message.goal) for r in records(log) if r.topic == "episode"])
    assert arenas[0] and all(list(map(str, arena)) == list(map(str, arenas[0])) for arena in arenas)


def test_another_task_in_another_arena_has_its_contacts_in_the_table(rivals, tmp_path):
    """Of its own observation, in `many-walkers`; results from before there were walkers have no such rows."""
    study = replace(TINY, robot="ground+tracks", method="ddpc", arenas=("many-walkers",), steps=400)
    try:
        cell = run(study, tmp_path)
        assert MLP.load(tmp_path / "policy.safetensors", GROUND).sizes == (50, 16, 16, 2)
    finally:
        learnt("ground")
    episodes = cell["evaluations"]["trained-ddpc-many-walkers"]["episodes"]
    episodes["contact_standing"] = [1]
    rows = table([cell])["parts"]["many-walkers"]["ddpc"]
    assert rows["run into while standing"].value == 1.0 and rows["run into while moving"].value == 0.0
    assert "| run into while standing | 100.0 % [100.0, 100.0] |" in markdown(table([cell]))
    del episodes["contact_moving"]
    assert "run into while standing" not in table([cell])["parts"]["many-walkers"]["ddpc"]


def test_only_where_a_policy_and_a_filter_are_crossed_there_are_more_trials():
    assert [t.name for t in replace(TINY, method="secas").trials()] == ["trained-secas-default"]
    assert Trial("trained", "none", "default", 1) in replace(TINY, method="ddpc").trials()
    assert Trial("untrained", "ddpc", "default", 1) in replace(TINY, method="ddpc").trials()
    assert Trial("trained", "ddpc", "default", 1) in TINY.trials()


def test_sailrs_interventions_end_episodes_in_training_and_not_in_evaluation(cells):
    training = cells["sailr"]["training"]["episodes"]
    assert max(training["interventions"]) <= 1
    columns = (training[name] for name in ("interventions", "goal", "collision", "timeout"))
    for ended, goal, collision, timeout in zip(*columns, strict=True):
        assert ended or goal or collision or timeout


def test_the_table_curves_and_points_of_real_cells(cells, tmp_path):
    found = table(cells.values())
    text = markdown(found)
    for name in ("| ours | SAILR | SECAS | TD3 |", "*paper*", "## training", "## default", "## deployment", "*80.4*"):
        assert name in text
    json.dumps(plain(found))
    once = without_times(plain(found))
    assert "decision [ms]" not in json.dumps(once) and "goal rate" in json.dumps(once)
    learning_curves(list(cells.values()), tmp_path / "curves.png")
    seeds_as_points(found, tmp_path / "seeds.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000 < (tmp_path / "seeds.png").stat().st_size
    with pytest.raises(ValueError, match="not the same seeds"):
        table([*cells.values(), cells["none"] | {"study": cells["none"]["study"] | {"seed": 9}}])


def test_the_studies_of_a_comparison():
    every = studies("ground", (0, 1, 2))
    assert [s.name for s in every[:5]] == ["ddpc-s0", "sailr-s0", "secas-s0", "none-s0", "ddpc-s1"]
    assert len(every) == 12 and {s.episodes for s in every} == {500} and every[0].arenas == ("default", "dense")
    assert len({json.dumps(s.config()) for s in every}) == 12
    assert quick(every[0]).steps < 5000 and Cell(every[0]).name == "ddpc-s0"


# --- figures -------------------------------------------------------------------------------------------------------


def test_intervals_cover_what_they_should():
    """Seeds differ by 0.1, episodes by a coin: the truth is inside about as often as it is claimed to be."""
    inside, lengths = 0, []
    for number in range(60):
        rng = np.random.default_rng(number)
        seeds = 0.5 + 0.1 * rng.normal(size=8)
        found = mean([(rng.random(100) < p).astype(float) for p in np.clip(seeds, 0, 1)], seed=number)
        inside += found.low <= 0.5 <= found.high
        lengths.append(found.high - found.low)
        assert found.low <= found.value <= found.high and len(found.seeds) == 8
    assert inside >= 48
    assert 0.08 < np.mean(lengths) < 0.25, "the spread of the seeds is in it, not the coins' alone"


def test_a_ratio_is_of_sums_and_of_seeds_alike():
    found = ratio([[1.0, 2.0], [30.0]], [[1.0, 1.0], [10.0]])
    assert found.seeds == (1.5, 3.0) and found.value == pytest.approx(2.25)
    certain = mean([np.ones(5), np.ones(5)])
    assert (certain.low, certain.value, certain.high) == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="at least one episode"):
        mean([[]])


def test_steps_to_learn_is_when_nine_of_ten_episodes_reach_the_goal():
    goals = [0] * 30 + [1] * 100
    steps = [10] * 130
    assert steps_to_learn({"goal": goals, "steps": steps}, 5000) == 10 * (30 + 45)
    assert steps_to_learn({"goal": [0] * 130, "steps": steps}, 5000) == 5000
    assert steps_to_learn({"goal": [1] * 10, "steps": [10] * 10}, 5000) == 5000, "too few episodes to tell"
