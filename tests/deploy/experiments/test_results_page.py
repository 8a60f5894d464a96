"""The results page: every figure follows from the stored cells, and cells of different conditions are not mixed."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.deploy.commands import compare_command
from brakeline.deploy.commands.compare_command import CompareCommand
from brakeline.deploy.data import model_store
from brakeline.deploy.experiments import bootstrap, conservatism, results_page
from brakeline.deploy.experiments.compared_methods import METHODS
from brakeline.deploy.experiments.comparison_cells import cell_configs, learning
from brakeline.deploy.experiments.comparison_table import markdown, table
from brakeline.deploy.experiments.conservatism import Conservatism
from brakeline.deploy.experiments.evaluate import FRESH
from brakeline.deploy.experiments.experiment_jobs import configuration
from brakeline.deploy.experiments.results_page import RobotResults, page
from brakeline.deploy.experiments.stored_cells import check_addable, stored_cells
from brakeline.deploy.experiments.tuning_trials import (
    SEED_KEY,
    FilterTuning,
    LearnerTuning,
    best_learner,
    tuning_jobs,
)
from brakeline.errors import ResultError
from brakeline.learner.learner_config import TD3Config
from brakeline.messaging.task import robot_with_task
from tests.full_disk import full_disk

# Of 100 episodes, by run; in `dense` 10 fewer.
GOALS = {"ddpc": (100, 98, 96, 94), "none": (97, 93, 80), "sac": (90,), "lagrange": (90,)}


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr(bootstrap, "RESAMPLES", 500)


@pytest.fixture
def results(tmp_path):
    """A folder with the stored cells of the ground robot."""
    store(tmp_path / "ground")
    return tmp_path


def change(path, how):
    """Change the content of a stored cell."""
    cell = json.loads(path.read_text())
    how(cell)
    path.write_text(json.dumps(cell))


def evaluation(goals: int, collisions: int) -> dict:
    episodes = {"goal": [1] * goals + [0] * (100 - goals), "collision": [1] * collisions + [0] * (100 - collisions)}
    columns = {name: [value] * 100 for name, value in {"steps": 50, "interventions": 5, "reward": 1.0}.items()}
    columns |= {"speed": [5.0] * 100, "fastest": [0.2] * 100}
    return {"episodes": episodes | columns, "decision_ms": {"mean": 0.5, "std": 0.1}}


def store(folder) -> None:
    """Store cells with known figures."""
    folder.mkdir(exist_ok=True, parents=True)
    for method, runs in GOALS.items():
        for cell, goals in zip(cell_configs("ground", (method,), range(len(runs))), runs, strict=True):
            settings = robot_with_task("ground").task.learner
            own = replace(cell, physics=2, td3=learning(TD3Config(), method, "ground", settings))
            hit = 0 if method == "ddpc" else 2
            training = evaluation(90, 3 * hit) | {"steps": 60_000}
            trials = {f"trained-{method}-default": evaluation(goals, hit)}
            for name in (method, METHODS[method].filter):
                trials[f"trained-{name}-dense"] = evaluation(goals - 10, hit)
            for name in ("trained-none-default", "trained-ddpc-default", "untrained-ddpc-default"):
                trials.setdefault(name, evaluation(50, 0))
            model = {"version": "1", "samples": "60000", "collisions": "0"} if method == "ddpc" else None
            result = {"study": configuration(own), "model": model, "training": training, "evaluations": trials}
            (folder / f"{own.name}.json").write_text(json.dumps(result))


def test_every_figure_follows_from_the_cells(results):
    text = page(results, ["ground", "quadrotor"])
    assert "| ours | 4 | 97.0 % [" in text and "| TD3 | 3 | 90.0 % [" in text, "middle half, all of three"
    assert "0 of 400: 0.00 % [0.00, 0.92]" in text and "6 of 300: 2.00 % [0.74, 4.30]" in text
    assert "| SAC | 1 | SAC | – |" in text and "| TD3-Lagrange | 1 | TD3 with a multiplier | – |" in text
    assert "| 6.0 (6 to 6) |" in text and "| ours over TD3 | 0.83 [" in text, "10 of 12 pairs"
    assert "| 10.0 % | 10.0 % | 0.50 | 0.50 |" in text and "60,000 training steps" in text
    assert "## quadrotor" not in text
    goals = RobotResults("ground", stored_cells(results, "ground")).goals("none")
    assert goals.shape == (2, 3) and np.allclose(goals[1], [0.87, 0.83, 0.7])


def test_steps_that_no_run_needed_have_no_interval(results):
    for path in (results / "ground").glob("*.json"):
        if json.loads(path.read_text())["study"]["method"] == "none":
            change(path, lambda cell: cell["training"]["episodes"].update(goal=[0] * 100))
    assert "| TD3 | 60,000 | 0 of 3 |" in page(results, ["ground"])


def test_cells_of_two_simulators_and_of_two_settings_of_a_rival_are_not_mixed(results):
    old = results / "ground" / "none-s0.json"
    change(old, lambda cell: cell["study"].pop("physics"))
    with pytest.raises(ResultError, match="more than one physics"):
        page(results, ["ground"])
    many = json.loads(old.read_text())["study"]["robots"]
    change(old, lambda cell: cell["study"].update(physics=2, robots=many + 1))
    with pytest.raises(ResultError, match="more than one robots"):
        page(results, ["ground"])
    change(old, lambda cell: cell["study"].update(robots=many))
    for number, margin in enumerate((0.0, 0.02)):
        path = results / "ground" / f"ddpc-s{number}.json"
        change(path, lambda cell, margin=margin: cell["model"].update(settings={"margin": margin}))
    with pytest.raises(ResultError, match="ddpc has cells of several settings"):
        stored_cells(results, "ground")


def test_the_page_says_which_filters_were_made_several_times(results):
    """Cells of one configuration may still be of several model sets: those of another recording, or of other code."""
    assert "| sets from recorded driving |" in page(results, ["ground"])
    change(results / "ground" / "ddpc-s1.json", lambda cell: cell["model"].update(version="2"))
    assert "| sets from recorded driving; made 2 times: 1, 2 |" in page(results, ["ground"])


def test_page_and_table_name_the_versions_that_made_the_cells_if_there_are_several(results):
    versions = {"brakeline": "0.3.0", "mujoco": "4.0.0"}
    paths = sorted((results / "ground").glob("*-s*.json"))
    for path in paths:
        change(path, lambda cell: cell.update(versions=versions))
    assert "versions made" not in page(results, ["ground"]) + markdown(table(stored_cells(results, "ground")))
    change(results / "ground" / "none-s1.json", lambda cell: cell.update(versions=versions | {"brakeline": "0.2.0"}))
    change(results / "ground" / "none-s2.json", lambda cell: cell.pop("versions"))
    notes = "brakeline 0.3.0, mujoco 4.0.0 (", "brakeline 0.2.0, mujoco 4.0.0 (none-s1)", "not stated (none-s2)"
    for text in page(results, ["ground"]), markdown(table(stored_cells(results, "ground"))):
        assert "3 versions made the cells" in text and all(note in text for note in notes)


def test_cells_of_two_learners_are_not_mixed_and_the_page_names_their_settings(results):
    grown = {"penalty_growth": 4.0, "imitation": 1.0}
    for path in (results / "ground").glob("ddpc-s*.json"):
        change(path, lambda cell: cell["study"]["td3"].update(grown))
    text = page(results, ["ground"])
    rates = "actor_rate 0.0003, critic_rate 0.0003"
    assert f"| learner of ours | {rates}, penalty for corrections 1, penalty_growth 4, imitation 1 |" in text
    assert f"| learner of TD3 | {rates} |" in text and "| learner of SAC | learning rate 0.0003 |" in text
    assert f"| learner of TD3-Lagrange | {rates}, cost_limit 0.01, multiplier_rate 1 |" in text
    for name in grown:  # as in a version that did not have these settings yet
        change(results / "ground" / "none-s0.json", lambda cell, name=name: cell["study"]["td3"].pop(name))
    assert page(results, ["ground"]) == text
    change(results / "ground" / "ddpc-s0.json", lambda cell: cell["study"]["td3"].update(imitation=0.5))
    with pytest.raises(ResultError, match="ddpc has cells of several settings"):
        stored_cells(results, "ground")


def test_a_rare_collision_does_not_read_as_none(results):
    """One collision in four trainings is 0.25 in a training, and 0 of 400 episodes may be up to 0.92 %."""
    path = results / "ground" / "ddpc-s0.json"
    change(path, lambda cell: cell["training"]["episodes"].update(collision=[1] + [0] * 99))
    lines = markdown(table(stored_cells(results, "ground"))).splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("| coll")]
    assert rows[0][:2] == ["collision rate", "0.25 % [0.00, 1.25]"] and rows[0][2].startswith("6.00 % [")
    assert rows[1][:3] == ["collisions", "0.2", "6.0"], "a mean over the seeds"
    assert rows[2][1] == "0.00 % [0.00, 0.92]"


@pytest.mark.parametrize("mirrored, words", [("turns", "learns from mirrored steps"), ("none", "actor_rate")])
def test_the_page_says_which_learners_had_mirrored_steps(results, monkeypatch, mirrored, words):
    """Stable-Baselines3's SAC has the same ones as TD3."""
    ground = robot_with_task("ground")
    task = replace(ground.task, symmetry=mirrored)
    monkeypatch.setattr(results_page, "robot_with_task", lambda name: replace(ground, task=task))
    lines = [line for line in page(results, ["ground"]).splitlines() if "| learner of" in line]
    rows = {line.split("|")[1].strip(): line for line in lines}
    assert words in rows["learner of TD3"]
    for learner in ("TD3", "SAC", "ours"):
        assert ("learns from mirrored steps" in rows[f"learner of {learner}"]) == (mirrored == "turns")


def test_the_page_names_no_penalty_for_sailr_which_pays_none(results):
    """An intervention ends its episodes of training: `tests/deploy/run/test_batch_trainer.py`."""
    (cell,) = cell_configs("ground", ("sailr",), (0,))
    trials = {f"trained-sailr-{arena}": evaluation(90, 0) for arena in ("default", "dense")}
    training, model = evaluation(90, 0) | {"steps": 60_000}, {"version": "1", "samples": "80000", "collisions": "770"}
    result = {"study": configuration(replace(cell, physics=2)), "model": model, "training": training}
    (results / "ground" / "sailr-s0.json").write_text(json.dumps(result | {"evaluations": trials}))
    lines = [line for line in page(results, ["ground"]).splitlines() if "| learner of" in line]
    (sailr,) = (line for line in lines if "SAILR" in line)
    assert "no penalty for corrections" in sailr and any("penalty for corrections 1" in line for line in lines)


def test_the_command_writes_the_page_and_the_figures_without_a_run(results):
    assert CompareCommand(("ground",), table=True, results=results, quiet=True).run() == 0
    assert (results / "README.md").read_text() == page(results, ["ground"])
    written = {path.name for path in (results / "ground").iterdir()}
    assert written > {"profiles.png", "curves.png", "seeds.png", "table.md", "table.json"}


def test_a_comparison_of_some_methods_keeps_the_others_in_its_table(results, monkeypatch):
    monkeypatch.setattr(model_store, "method_for", lambda *_: SimpleNamespace(version="1"))
    some = CompareCommand(("ground",), (0,), methods=("none",), conservatism=False, results=results, quiet=True)
    assert some.run() == 0
    seeds = json.loads((results / "ground" / "table.json").read_text())["seeds"]
    assert {method: len(numbers) for method, numbers in seeds.items()} == {m: len(runs) for m, runs in GOALS.items()}


@pytest.mark.parametrize(
    "changed, words",
    [
        ({"steps": 100}, r"more than one steps \(100, 60000\)"),
        ({"penalty": 3.0}, "none has cells of several settings"),
    ],
)
def test_cells_that_do_not_compare_with_stored_ones_are_refused_before_they_are_made(
    results, monkeypatch, changed, words
):
    monkeypatch.setattr(model_store, "method_for", lambda *_: SimpleNamespace(version="1"))
    monkeypatch.setattr(compare_command, "complete", lambda *_: pytest.fail("a training began"))
    with pytest.raises(ResultError, match=words):
        CompareCommand(("ground",), (7,), methods=("none",), conservatism=False, results=results, **changed).run()


def test_a_full_disk_leaves_the_tables_that_were_there(results):
    command = CompareCommand(("ground",), table=True, results=results, quiet=True)
    assert command.run() == 0
    before = {path: path.read_bytes() for path in results.rglob("*") if path.suffix in (".md", ".json")}
    with full_disk(1_000), pytest.raises(OSError, match="File too large"):
        command.run()
    assert before == {path: path.read_bytes() for path in before}


def test_a_copied_cell_does_not_count_twice(results):
    cell = results / "ground" / "ddpc-s0.json"
    copy = cell.with_name("ddpc-s7.json")
    copy.write_text(cell.read_text())
    with pytest.raises(ResultError, match=r"ddpc-s7\.json holds the cell ddpc-s0"):
        stored_cells(results, "ground")
    with pytest.raises(ResultError, match=r"ddpc-s7\.json holds the cell ddpc-s0"):
        check_addable(results, cell_configs("ground", ("none",), (7,)))


def without_an_arena(cell):
    del cell["evaluations"]["trained-none-dense"]


def without_an_episode(cell):
    cell["evaluations"]["trained-none-dense"]["episodes"]["goal"].pop()


def with_fewer_episodes(cell):
    for column in cell["evaluations"]["trained-none-dense"]["episodes"].values():
        column.pop()


def with_fewer_crossed_episodes(cell):
    for column in cell["evaluations"]["untrained-ddpc-default"]["episodes"].values():
        column.pop()


def without_a_number(cell):
    cell["training"]["episodes"]["reward"][3] = float("nan")


@pytest.mark.parametrize(
    ("how", "words"),
    [
        (without_an_arena, r"none-s0\.json has no evaluation trained-none-dense"),
        (without_an_episode, r"none-s0\.json: the episodes of trained-none-dense"),
        (with_fewer_episodes, "more than one number of episodes in trained-none-dense"),
        (with_fewer_crossed_episodes, "more than one number of episodes in untrained-ddpc-default"),
        (without_a_number, r"none-s0\.json: the episodes of the training"),
    ],
)
def test_a_cell_that_is_not_whole_is_named(results, how, words):
    change(results / "ground" / "none-s0.json", how)
    with pytest.raises(ResultError, match=words):
        stored_cells(results, "ground")


def test_cells_with_other_numbers_of_recorded_periods_are_not_mixed(results):
    """The tables state one number for all seeds of a method."""
    change(results / "ground" / "ddpc-s0.json", lambda cell: cell["model"].update(samples=1_000))
    with pytest.raises(ResultError, match="ddpc has cells of several settings"):
        stored_cells(results, "ground")


def test_cells_of_two_versions_of_a_filter_of_your_own_are_not_mixed(results):
    """The file of a filter may change between two seeds."""
    for number, code in enumerate(("1", "2")):
        change(results / "ground" / f"none-s{number}.json", lambda cell, code=code: cell["study"].update(code=code))
    with pytest.raises(ResultError, match="none has cells of several settings"):
        stored_cells(results, "ground")


def test_the_page_does_not_state_one_methods_learner_as_that_of_all(results):
    """`compare --td3.gamma 0.9 --methods none` gives one method another learner."""
    for path in (results / "ground").glob("none-s*.json"):
        change(path, lambda cell: cell["study"]["td3"].update(gamma=0.9))
    rows = {row.split("|")[1].strip(): row for row in page(results, ["ground"]).splitlines() if row.startswith("| ")}
    assert "gamma" not in rows["all learners"] and "batch 128" in rows["all learners"]
    assert "gamma 0.9," in rows["learner of TD3"] and "gamma 0.99," in rows["learner of ours"]


def test_a_damaged_cell_is_named_with_what_to_do(results):
    (results / "ground" / "ddpc-s0.json").write_text('{"study": {"robot": "gro')
    with pytest.raises(ResultError, match=r"ddpc-s0\.json is damaged .* run again with --again"):
        stored_cells(results, "ground")


def test_rivals_are_tuned_over_as_many_values_and_the_page_lists_them(results):
    jobs = tuning_jobs("ground", tuple(METHODS), ("default", "dense"))
    counts = {job.method: sum(other.method == job.method for other in jobs) for job in jobs}
    assert counts == dict.fromkeys(("sailr", "secas", "cbf", "psf", "sac"), 4) | {"lagrange": 6}
    assert len({job.name for job in jobs}) == len(jobs)
    assert {job.seed_key for job in jobs} == {SEED_KEY} and abs(SEED_KEY - FRESH) > 1000, (
        "other rooms than the evaluation"
    )
    assert {job.cell.td3.multiplier_rate for job in jobs if job.method == "lagrange"} >= {0.1, 1.0, 30.0}
    for job in jobs:
        if isinstance(job, FilterTuning):
            row = {"oracle_goals": 60, "oracle_interventions": 0.1, "greedy_goals": 20, "episodes": 60}
            row |= {"greedy_collisions": 1 + (job.value > 1.5), "value": job.value}
        else:
            assert isinstance(job, LearnerTuning) and job.cell.seed == 1000
            row = {"goals": 118, "collisions": int(job.value), "training_collisions": 7, "episodes": 120}
            row |= {"value": job.value}
        (results / "ground" / f"{job.name}.json").write_text(json.dumps({"study": configuration(job), **row}))
    text = page(results, ["ground"])
    assert "| CBF-QP | rate α [1/s] | **0.5**: A* 60 goals; greedy 20, 1 collisions |" in text
    assert "**30**: 118 goals, 30 collisions; 7 in training | 0.1 | 1 |" in text
    path = results / "ground" / "tuning-cbf-0.5.json"
    change(path, lambda row: row["study"].update(physics=1))
    with pytest.raises(ResultError, match=r"tuning-cbf-0\.5\.json is of version 1 of the simulator, the cells of 2"):
        page(results, ["ground"])
    change(path, lambda row: row["study"].update(physics=2))
    path.with_name("tuning-cbf-8.json").write_text(path.read_text())
    with pytest.raises(ResultError, match=r"tuning-cbf-8\.json holds the value 0\.5 of cbf"):
        page(results, ["ground"])


def test_the_best_learner_has_the_fewest_collisions_of_those_that_reach_the_goal():
    rows = [{"goals": g, "collisions": c, "episodes": 120} for g, c in ((110, 4), (108, 1), (90, 0), (112, 1))]
    assert best_learner(rows) is rows[3]


def test_a_missing_extra_of_a_method_is_told_before_any_training(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ModuleNotFoundError, match="stable_baselines3"):
        CompareCommand(("ground",), methods=("none", "sac"), results=tmp_path, runs=tmp_path, quiet=True).run()
    assert not list(tmp_path.iterdir())


SAID = {"half_width_rest": 0.0056, "half_width_full": 0.0081, "violations": 2, "windows": 1981, "bound_plan": 0.004236}


def test_every_kind_of_row_of_the_certificates_has_all_columns():
    """What was driven, what is too wide to drive, and what was refused."""
    drove = {"collisions": 0, "interventions": 0.05, "steps": 900, "decision_ms": {"mean": 0.2, "std": 0}}
    driving = {"astar": drove | {"goals": 60}, "x": drove | {"goals": 7}}
    wide = SAID | {"half_width_full": 3e5}
    rows = [
        {"certificate": "residual", "mode": "direct", "statement": SAID, "driving": driving},
        {"certificate": "residual", "mode": "recursion", "statement": wide, "driving": None},
        {"certificate": "matrix-zonotope", "mode": "recursion", "refused": "poor data"},
    ]
    study = configuration(Conservatism("ground", policies=("astar", "x")))
    lines = conservatism.markdown({"study": study, "rows": rows}).splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1 and len(table) == 5
    assert "| 5.6 mm | 8.1 mm | 2 of 1981 | 0.43 % | 60, 5.0% | 7, 5.0% |" in table[2]
    assert "3e+05 m" in table[3] and "not driven" in table[3] and "refused: poor data" in table[4]
