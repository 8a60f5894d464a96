"""The comparison: cells, figures by hand, and the same seed twice."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.deploy.cli import parse
from brakeline.deploy.commands import compare_command
from brakeline.deploy.commands.campaign_command import CampaignCommand
from brakeline.deploy.commands.collect_command import CollectCommand
from brakeline.deploy.commands.compare_command import CompareCommand
from brakeline.deploy.data import model_store, rival_pretraining
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.experiments import bootstrap, cell_run, compared_methods
from brakeline.deploy.experiments.bootstrap import mean, rate, ratio
from brakeline.deploy.experiments.campaign import CampaignPart
from brakeline.deploy.experiments.comparison_cells import (
    CellConfig,
    TrialConfig,
    backend_for,
    cell_configs,
    compared_on,
    learning,
    quick,
)
from brakeline.deploy.experiments.comparison_plots import learning_curves, seeds_as_points
from brakeline.deploy.experiments.comparison_table import (
    THIRDS,
    _goals_by_third,
    evaluation_rows,
    markdown,
    plain,
    steps_to_learn,
    table,
    written,
)
from brakeline.deploy.experiments.conservatism import Conservatism
from brakeline.deploy.experiments.episode_table import EpisodeTable
from brakeline.deploy.experiments.experiment_jobs import configuration, result_path, task_hash, write
from brakeline.deploy.experiments.experiment_jobs import read as read_result
from brakeline.deploy.experiments.stored_cells import stored_cells
from brakeline.deploy.experiments.task_engine import Engine
from brakeline.deploy.experiments.tuning_trials import tuning_jobs, values_of
from brakeline.deploy.run.first_flight_run import FirstFlightSettings
from brakeline.errors import ResultError, UnknownName
from brakeline.learner.learner_config import TD3Config
from brakeline.learner.rival_networks import FitConfig
from brakeline.logs.figure_tables import analyse
from brakeline.logs.reader import read
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging import task
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.task import read_task, robot_with_task
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND

MEASURED = ("decision_ms", "milliseconds", "folder", "seconds")  # no two runs agree on these
METHODS = ("ddpc", "sailr", "secas", "none")
SINGLE, BATCH = "single", "batch"
BACKENDS = {SINGLE: {}, BATCH: {"backend": "batch", "robots": 8}}
EACH = [*((method, SINGLE) for method in METHODS), *((method, BATCH) for method in ("ddpc", "sailr", "sac-ddpc"))]


@pytest.fixture(autouse=True, scope="module")
def few_resamples():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bootstrap, "RESAMPLES", 500)
        yield


# --- studies -------------------------------------------------------------------------------------------------------

TINY = CellConfig("ground", "none", 3, steps=160, episodes=1, arenas=("default",), untrained=1)
TINY = replace(TINY, td3=replace(TINY.td3, hidden=(16, 16), batch=16, warmup=40))


def tiny(method, backend=SINGLE) -> CellConfig:
    return replace(TINY, method=method, **BACKENDS[backend])


@pytest.fixture(scope="module")
def rivals(data_folder):
    """Rivals that know next to nothing, made in seconds; and robots that drive until an early time limit."""

    def shortened(path):
        known = read_task(path)
        return replace(known, arenas={name: replace(kind, step_limit=40) for name, kind in known.arenas.items()})

    little = {"samples": 300, "fit": FitConfig(hidden=(8, 8), epochs=1, batch=32)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "read_task", shortened)
        for method, config in (("secas", rival_pretraining.SecasConfig), ("sailr", rival_pretraining.SailrConfig)):
            patch.setitem(rival_pretraining.CONFIGS, method, partial(config, **little))
            model_store.method_for(GROUND, method, ModelConfig())
        yield


@pytest.fixture(scope="module")
def cells(rivals, tmp_path_factory) -> dict[tuple[str, str], dict]:
    """By method and backend: one robot, and eight at once by the batch filter, row by row and with another learner."""
    root, made = tmp_path_factory.mktemp("cells"), {}
    for method, backend in EACH:
        folder = root / f"{method}-{backend}"
        made[method, backend] = tiny(method, backend).run(folder) | {"folder": folder}
    return made


def repeatable(value):
    """Return the part of a result that no clock has a part in."""
    if isinstance(value, dict):
        return {name: repeatable(part) for name, part in value.items() if name not in MEASURED}
    return value


def test_the_progress_of_a_training_counts_episodes():
    """It read "goals 100%" after 3,000 steps of 16 robots, of which one episode had ended: the shortest."""
    one, many = EpisodeTable(rows=[{"goal": 1}], decisions=3000), EpisodeTable(rows=[{"goal": 0}, {"goal": 1}] * 40)
    assert cell_run.progress(one) == "step 3000, 1 of the last 1 episodes reached the goal"
    assert cell_run.progress(many) == "step 0, 25 of the last 50 episodes reached the goal"
    assert cell_run.progress(EpisodeTable()) == "step 0, 0 of the last 0 episodes reached the goal"


def test_the_same_seed_gives_the_same_cell_and_another_seed_another(cells, tmp_path):
    for method, backend in (("ddpc", SINGLE), ("sailr", BATCH)):
        again = tiny(method, backend).run(tmp_path / method)
        assert repeatable(again) == repeatable(cells[method, backend])
    other = replace(tiny("none"), seed=4).run(tmp_path / "other")
    assert other["policy"] != cells["none", SINGLE]["policy"]


@pytest.mark.parametrize(("method", "backend"), EACH)
def test_a_cell_says_what_its_logs_say(cells, method, backend):
    cell = cells[method, backend]
    for name, evaluation in [("training", cell["training"]), *cell["evaluations"].items()]:
        figures = analyse(cell["folder"] / f"{name}.mcap")
        episodes = evaluation["episodes"]
        assert figures["episodes"] == len(episodes["goal"]) and figures["goals"] == sum(episodes["goal"])
        assert sum(episodes["steps"]) <= figures["steps"]
        if episodes["reward"]:  # in so short a training, no robot of a batch may have ended its first episode
            assert figures["mean_reward"] == pytest.approx(np.mean(episodes["reward"]), abs=1e-3)
        assert figures["seed"] == TINY.seed
        assert figures["method"] == (method if name == "training" else name.split("-")[1])
    assert cell["training"]["steps"] == TINY.steps
    assert 0.9 * (TINY.steps - TINY.td3.warmup) <= cell["training"]["updates"] <= TINY.steps
    assert json.loads(json.dumps(cell["study"])) == configuration(tiny(method, backend))
    assert MLP.load(cell["folder"] / "policy.safetensors", GROUND).sizes == (26, 16, 16, 2)


def test_methods_and_backends_share_the_episodes_that_they_are_evaluated_on(cells):
    arenas = []
    for (method, _), cell in cells.items():
        log = cell["folder"] / f"trained-{method.removeprefix('sac-')}-default.mcap"
        arenas.append([str((r.message.start, r.message.goal)) for r in read(log) if r.topic == "episode"])
    assert arenas[0] and all(arena == arenas[0] for arena in arenas)


def test_another_task_in_another_arena_has_its_contacts_in_the_table(rivals, tmp_path):
    """Of its own observation, in `many-walkers`; results from before there were walkers have no such rows."""
    study = replace(TINY, robot="ground+tracks", method="ddpc", arenas=("many-walkers",))
    cell = study.run(tmp_path)
    tracking = robot_with_task("ground+tracks")
    assert MLP.load(tmp_path / "policy.safetensors", tracking).sizes == (50, 16, 16, 2)
    episodes = cell["evaluations"]["trained-ddpc-many-walkers"]["episodes"]
    episodes["contact_standing"] = [1]
    rows = table([cell])["parts"]["many-walkers"]["ddpc"]
    assert rows["run into while standing"].value == 1.0 and rows["run into while moving"].value == 0.0
    assert "| run into while standing | 100.00 % [2.50, 100.00] |" in markdown(table([cell]))  # exact, of one episode
    del episodes["contact_moving"]
    assert "run into while standing" not in table([cell])["parts"]["many-walkers"]["ddpc"]


def test_only_where_a_policy_and_a_filter_are_crossed_there_are_more_trials():
    assert [t.name for t in replace(TINY, method="secas").trials()] == ["trained-secas-default"]
    assert TrialConfig("trained", "none", "default", 1) in replace(TINY, method="ddpc").trials()
    assert TrialConfig("untrained", "ddpc", "default", 1) in replace(TINY, method="ddpc").trials()
    assert TrialConfig("trained", "ddpc", "default", 1) in TINY.trials()


def test_sailrs_interventions_end_episodes_in_training_and_not_in_evaluation(cells):
    training = cells["sailr", SINGLE]["training"]["episodes"]
    assert max(training["interventions"]) == 1
    columns = (training[name] for name in ("interventions", "goal", "collision", "timeout"))
    for ended, goal, collision, timeout in zip(*columns, strict=True):
        assert ended or goal or collision or timeout


def test_the_table_curves_and_points_of_real_cells(cells, tmp_path):
    singles = [cells[method, SINGLE] for method in METHODS]
    without_filter = singles[-1]

    def changed(**study):
        return [*singles, without_filter | {"study": without_filter["study"] | study}]

    rows = table(singles)
    text, figures = markdown(rows), json.dumps(plain(rows))
    assert "| ours, n = 1 | SAILR, n = 1 | SECAS, n = 1 | TD3, n = 1 |" in text
    assert all(word in text for word in ("*paper*", "## training", "## default", "## deployment", "*80.4*"))
    assert "decision [ms]" in text and "goal rate" in figures and "--quick" not in text
    short = markdown(rows, quick=True)
    assert "A test of the code (`--quick`), no result" in short and "| *paper* |" not in short
    learning_curves(singles, tmp_path / "curves.png")
    seeds_as_points(rows, tmp_path / "seeds.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000 < (tmp_path / "seeds.png").stat().st_size
    assert "| SECAS, n = 1 | TD3, n = 2 |" in markdown(table(changed(seed=9)))
    assert "**" not in markdown(table(changed(method="lagrange"))), "the paper has no figure of TD3-Lagrange"
    with pytest.raises(ValueError, match="one robot"):
        table(changed(robot="quadrotor"))


def test_the_help_of_the_methods_names_each_of_them(capsys):
    with pytest.raises(SystemExit):
        parse("compare", ["--help"])
    words = set(re.findall(r"[\w-]+", capsys.readouterr().out))
    assert set(compared_methods.METHODS) <= words


def test_the_studies_of_a_comparison():
    every = cell_configs("ground", METHODS, (0, 1, 2))
    assert [s.name for s in every[:5]] == ["ddpc-s0", "sailr-s0", "secas-s0", "none-s0", "ddpc-s1"]
    assert len(every) == 12 and {s.episodes for s in every} == {500} and every[0].arenas == ("default", "dense")
    assert len({json.dumps(configuration(s)) for s in every}) == 12
    assert len(cell_configs("ground", METHODS)) == 40 and every[0].backend == "batch"
    assert len(cell_configs("ground+tracks", METHODS)) == 12 and cell_configs("quadrotor", METHODS)[0].robots == 16
    assert compared_on("quadrotor", ("default",)) == (*METHODS, "lagrange", "cbf", "psf", "sac", "sac-ddpc")
    assert compared_on("ground+tracks", ("default",)) == METHODS and set(compared_on("ground", ("default",))) > {"psf"}
    brief = quick(every[0])
    assert GROUND.task.arenas["dense"].step_limit < brief.steps / brief.robots, "episodes end"
    assert brief.steps < 5000 and every[0].name == "ddpc-s0"


def test_the_penalty_for_corrections_is_the_tasks_but_for_the_rivals_that_were_tuned_with_1(monkeypatch):
    robot = robot_with_task("quadrotor")
    reward = replace(robot.task.reward, correction_penalty=7.0)
    changed = replace(robot, task=replace(robot.task, reward=reward))
    monkeypatch.setattr(task, "robot_with_task", lambda _: changed)
    cells = cell_configs("quadrotor", (*METHODS, "cbf"), (0,), backend="batch")
    assert {cell.method: cell.penalty for cell in cells} == {"ddpc": 7, "cbf": 7, "sailr": 1, "secas": 1, "none": 1}


# --- figures -------------------------------------------------------------------------------------------------------


def test_intervals_cover_what_they_should():
    """Seeds differ by 0.1, episodes by a coin: the truth is inside about as often as it is claimed to be."""
    inside, lengths = 0, []
    for number in range(18):
        rng = np.random.default_rng(number)
        seeds = 0.5 + 0.1 * rng.normal(size=8)
        estimate = mean([(rng.random(100) < p).astype(float) for p in np.clip(seeds, 0, 1)], seed=number)
        inside += estimate.low <= 0.5 <= estimate.high
        lengths.append(estimate.high - estimate.low)
        assert estimate.low <= estimate.value <= estimate.high and len(estimate.seeds) == 8
    assert inside >= 15
    assert 0.08 < np.mean(lengths) < 0.25, "the spread of the seeds is in it, not the coins' alone"


def test_intervals_cover_the_mean_also_where_all_seeds_drive_the_same_hard_rooms():
    """A room is hard for every policy. Drawn anew for each seed, such rooms would seem to average out."""
    generator, wide, narrow = np.random.default_rng(0), [], []
    inside = 0
    for _ in range(40):
        hard = 0.5 + 0.45 * generator.choice([-1.0, 1.0], size=60)
        seeds = [generator.random(60) < hard for _ in range(5)]
        estimate, apart = mean(seeds, crossed=True), mean(seeds)
        inside += estimate.low <= 0.5 <= estimate.high
        wide.append(estimate.high - estimate.low)
        narrow.append(apart.high - apart.low)
        assert estimate.value == apart.value and estimate.seeds == apart.seeds
    assert inside >= 36 and np.mean(wide) > 1.5 * np.mean(narrow)
    with pytest.raises(ValueError, match="same number"):
        mean([np.ones(3), np.ones(4)], crossed=True)


def test_episodes_that_an_intervention_cut_do_not_count_as_missed_goals():
    """SAILR ends a training episode when it brakes; an evaluation of the same policy goes on, mostly to the goal."""
    steps, cut = [10] * 200, [i % 2 for i in range(200)]
    goals = [int(not each) for each in cut]
    episodes = {"goal": goals, "steps": steps, "collision": [0] * 200, "timeout": [0] * 200}
    assert steps_to_learn(episodes, 5000) == 10 * 89, "the 45th episode that was not cut"
    assert steps_to_learn(episodes | {"timeout": cut}, 5000) == 5000, "episodes that ran out of time are misses"


def test_a_rate_without_an_event_has_an_exact_interval():
    never, always, once = rate([np.zeros(50)] * 3), rate([np.ones(50)] * 3), [np.eye(50)[0], np.zeros(50)]
    assert (never.value, never.low) == (0.0, 0.0) and never.high == pytest.approx(1.0 - 0.025 ** (1 / 150))
    assert (always.value, always.high) == (1.0, 1.0) and always.low == pytest.approx(0.025 ** (1 / 150))
    assert rate(once) == mean(once)


@pytest.mark.parametrize(("filtering", "high"), [("ddpc", 1.0 - 0.025 ** (1 / 80)), ("none", 0.0)])
def test_a_filter_that_never_intervened_has_an_interval(filtering, high):
    """It may intervene in another episode, as the caption of the table says. Without a filter, nothing can."""
    episodes = {name: [0] * 40 for name in ("goal", "collision", "fastest", "speed", "reward", "interventions")}
    evaluation = {"episodes": episodes | {"steps": [50] * 40}, "decision_ms": {"mean": 1.0, "std": 0.0}}
    trial = f"trained-{filtering}-dense"
    estimate = evaluation_rows([{"evaluations": {trial: evaluation}}] * 2, trial)["interventions"]
    assert (estimate.value, estimate.low, estimate.high) == (0.0, 0.0, pytest.approx(high))


def test_a_ratio_is_of_sums_and_of_seeds_alike():
    estimate = ratio([[1.0, 2.0], [30.0]], [[1.0, 1.0], [10.0]])
    assert estimate.seeds == (1.5, 3.0) and estimate.value == pytest.approx(2.25)
    certain = mean([np.ones(5), np.ones(5)])
    assert (certain.low, certain.value, certain.high) == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="at least one episode"):
        mean([[]])


def test_the_steps_of_one_training_have_no_interval():
    """An interval without a width would claim that each other seed needs as many steps."""
    assert written("steps to 90 % goals", mean([[4000.0]])) == "4000"
    assert "[" in written("steps to 90 % goals", mean([[4000.0], [5000.0]]))
    assert written("steps to 90 % goals", mean([[60_000.0]] * 5)) == "60000", "no seed got there"
    assert written("mean reward", mean([[4.0, 4.0]])) == "4 [4, 4]"


def test_steps_of_several_actors_are_rows_in_the_order_in_which_their_episodes_began():
    table = EpisodeTable()
    for actor, ended in (("slow", False), ("fast", False), ("fast", True), ("slow", False), ("fast", True)):
        table.step(pb.Step(actor=actor, terminated=ended, goal=ended, reward=1.0))
    assert table.columns()["steps"] == [2, 1] and table.span_columns() == {"begin": [1, 4], "end": [3, 5]}
    table.step(pb.Step(actor="slow", truncated=True))
    assert table.columns()["steps"] == [3, 2, 1] and table.columns()["goal"] == [0, 1, 1]
    assert table.span_columns() == {"begin": [0, 1, 4], "end": [6, 3, 5]}
    assert table.pop()["steps"] == 3 and table.columns()["steps"] == [2, 1]


def test_a_method_has_settings_of_its_own_unless_one_is_given_and_a_batch_has_none():
    assert backend_for("ground", ("default", "dense")) == backend_for("quadrotor", ("default", "dense")) == "batch"
    assert backend_for("ground", ("default", "walkers")) == backend_for("ground+tracks", ("default",)) == "single"
    task = robot_with_task("ground").task.learner
    given = replace(TD3Config(), updates_per_step=0.5)
    assert (
        learning(given, "none", "ground", task) == given
        and learning(TD3Config(), "none", "ground", task).updates_per_step == 1.0
    )
    assert given.cost_limit is None and learning(given, "lagrange", "ground", task).cost_limit is not None


def test_methods_whose_filter_replaces_inputs_have_the_learner_of_the_task():
    task = robot_with_task("quadrotor").task.learner
    assert task["imitation"] > 0.0
    for method in compared_methods.METHODS:
        used = learning(TD3Config(), method, "quadrotor", task)
        assert (used.imitation > 0.0) == (method in ("ddpc", "secas", "cbf", "psf")), method
    assert learning(replace(TD3Config(), imitation=0.5), "ddpc", "quadrotor", task).imitation == 0.5
    for wanted in (True, False):
        (job,), _ = CompareCommand(
            ("quadrotor",), (0,), methods=("ddpc",), conservatism=False, task_settings=wanted
        )._jobs("quadrotor")
        assert (job.td3.imitation > 0.0) == wanted


def test_a_setting_that_an_option_gives_stays_also_with_its_default_value(monkeypatch):
    """The table of SAC says 0.0003 and 0.003, the quadrotor's task a penalty growth, and --quick a small batch."""
    words = "--seeds 0 --no-conservatism --quick --methods"
    monkeypatch.setattr(compare_command, "import_module", lambda _: None)
    said = []
    monkeypatch.setattr(compare_command, "say", lambda *words: said.append(words))
    for robot, method, name, option, value in (
        ("ground", "sac-ddpc", "actor_rate", "--td3.actor-rate=0.003", 3e-3),
        ("quadrotor", "ddpc", "penalty_growth", "--td3.penalty-growth 1", 1.0),
        ("quadrotor", "ddpc", "batch", "--td3.batch 128", 128),
        ("quadrotor", "lagrange", "multiplier_rate", "--td3.multiplier-rate 1", 1.0),
        ("quadrotor", "sac-ddpc", "imitation", "--td3.imitation 0", 0.0),
    ):
        plain, given = (parse("compare", f"{robot} {words} {method} {more}".split()) for more in ("", option))
        ((usual,), _), ((chosen,), _) = (command._jobs(robot) for command in (plain, given))
        assert getattr(chosen.td3, name) == value and (getattr(usual.td3, name) != value or name == "imitation")
    assert said == [("quadrotor", "SAC, our filter has no --td3.imitation: it learns without")]
    with pytest.raises(ValueError, match="--table ignores --td3: leave"):
        parse("compare", ["--table", "--td3.batch", "128"]).run()
    assert learning(TD3Config(), "lagrange", "ground", {}, {"cost_limit"}).cost_limit is None


def test_a_penalty_out_of_proportion_for_any_robot_is_refused_before_the_first_training(monkeypatch):
    """The cell refused it, after it had built its model set: minutes later, or hours for the second robot."""
    monkeypatch.setattr(compare_command, "complete", lambda *_: pytest.fail("a training began"))
    for robots, penalty in ((("ground",), 20_000.0), (("ground", "quadrotor"), 1_800.0)):
        with pytest.raises(ValueError, match=f"out of proportion to the rewards of {robots[-1]}"):
            CompareCommand(robots, (0,), methods=("none",), penalty=penalty, conservatism=False).run()


def test_steps_to_learn_is_when_nine_of_ten_episodes_reach_the_goal():
    """In a batch, short episodes end first: half of the robots reach the goal soon, the others time out long after."""
    goals, steps = [0] * 30 + [1] * 100, [10] * 130
    assert steps_to_learn({"goal": goals, "steps": steps}, 5000) == 10 * (30 + 45)
    assert steps_to_learn({"goal": [0] * 130, "steps": steps}, 5000) == 5000
    assert steps_to_learn({"goal": [1] * 10, "steps": [10] * 10}, 5000) == 5000, "too few episodes to tell"
    ends = [100 + n if n % 2 else 3000 + n for n in range(100)]
    batch = {"goal": [n % 2 for n in range(100)], "steps": [1] * 100, "begin": [*range(100)], "end": ends}
    assert steps_to_learn(batch, 5000) == 5000
    later = {"goal": [1] * 50, "steps": [1] * 50, "begin": range(100, 150), "end": [4000 + n for n in range(50)]}
    assert steps_to_learn({name: [*values, *later[name]] for name, values in batch.items()}, 5000) == 4038


def test_a_training_without_a_whole_episode_has_dashes_and_its_evaluations_stay(cells, tmp_path):
    whole = cells[METHODS[-1], SINGLE]
    training = whole["training"] | {"episodes": {name: [] for name in whole["training"]["episodes"]}}
    rows = table([whole | {"training": training}])
    figures, text = next(iter(rows["parts"]["training"].values())), markdown(rows)
    assert figures["collision rate"] is None is figures["interventions"] and figures["collisions"] == 0.0
    assert "| collision rate | – |" in text and "no episode ended" in text and "| goal rate |" in text
    assert "no episode ended" not in markdown(table([whole]))
    learning_curves([whole | {"training": training}], tmp_path / "curves.png")
    seeds_as_points(rows, tmp_path / "seeds.png")


def test_the_goals_of_training_are_counted_in_thirds_of_the_steps():
    def trained(goals, ends):
        return {"steps": 300, "episodes": {"goal": goals, "steps": ends, "begin": [0] * len(ends), "end": ends}}

    ends = [100, 101, 200, 250, 308]  # in a batch, the last episode may end after the last step
    rates = _goals_by_third([trained([0, 1, 0, 1, 1], ends), trained([1, 1, 1, 0, 1], ends)])
    assert [rates[row].seeds for row in THIRDS] == [(0.0, 1.0), (0.5, 1.0), (1.0, 0.5)]
    empty = _goals_by_third([trained([1, 1], [10, 120])])
    assert empty[THIRDS[2]] is None and written(THIRDS[2], None) == "–" and plain(None) is None


def test_results_of_a_robot_of_ones_own_with_another_task_or_description_are_refused(tmp_path):
    """Else a study would show, or add up, episodes of arenas that the file no longer describes."""
    folder = shutil.copytree(Path(__file__).parents[3] / "examples" / "car", tmp_path / "car")
    car, before = str(folder / "car.toml"), {}

    def jobs():
        part = CampaignPart(car, "default", "random", "none", "as-recorded", 0.1, 0, 1)
        yield CampaignCommand(runs=tmp_path, results=tmp_path)._prepared(robot_with_task(car), part)
        cells, others = CompareCommand(methods=("ddpc",), seeds=(0,))._jobs(car)
        yield from (*cells, *others)
        yield from tuning_jobs(car, ("secas",), ("default",))

    for file, old, new in (("car.task.toml", "gap = 0.3", "gap = 0.4"), ("car.toml", "period = 0.2", "period = 0.3")):
        before = {job.name: job for job in jobs()}
        assert len(before) == 3 + len(values_of("secas", robot_with_task(car)))
        (folder / file).write_text(changed := (folder / file).read_text().replace(old, new, 1))
        assert new in changed
        for job in jobs():
            write(tmp_path / file, job, {"study": configuration(before[job.name])})
            with pytest.raises(ResultError, match=r"another .*task"):
                read_result(tmp_path / file, job)
    assert task_hash("ground") == task_hash("ground+tracks") == "", "shipped robots change with Brakeline only"


def test_a_robot_of_ones_own_is_compared_behind_the_model_set_in_use_and_in_the_arenas_that_it_has():
    """Mode direct was fitted anew, or failed on free driving; and without an arena `dense` the last training failed."""
    skid = str(Path(__file__).parents[3] / "examples" / "own_log" / "skid.toml")
    (cell,), others = CompareCommand(methods=("ddpc",), seeds=(0,))._jobs(skid)
    assert (cell.model_config.mode, cell.arenas, others) == ("auto", ("default",), []), "no policy is stored"
    (cell,), others = CompareCommand(methods=("ddpc",), seeds=(0,))._jobs("ground")
    assert (cell.model_config.mode, cell.arenas, len(others)) == ("direct", ("default", "dense"), 1)
    (cell,), others = CompareCommand(methods=("ddpc",), seeds=(0,), mode="one-step")._jobs("ground")
    assert cell.model_config.mode == "one-step" and not cell.of_shipped_set()
    with pytest.raises(UnknownName, match="no arena is called 'dense'"):
        CompareCommand(methods=("ddpc",), seeds=(0,), arenas=("dense",))._jobs(skid)
    with pytest.raises(ValueError, match="has no greedy"):
        tuning_jobs(skid, ("secas",), ("default",))


def test_cells_of_a_robot_of_ones_own_behind_another_model_set_are_refused(tmp_path, monkeypatch):
    folder = shutil.copytree(Path(__file__).parents[3] / "examples" / "car", tmp_path / "car")
    in_use = SimpleNamespace(version="first")
    for module in (model_store, cell_run):
        monkeypatch.setattr(module, "method_for", lambda *_: in_use)

    def noted(robot, methods=("ddpc", "none", "sailr"), seeds=(0,), mode=None):
        command = CompareCommand(methods=methods, seeds=seeds, conservatism=False, mode=mode)
        return command._prepared(command._jobs(robot)[0], tmp_path)

    car = str(folder / "car.toml")
    before = noted(car)
    assert [cell.model_set for cell in before] == ["first", "first", ""], "TD3 is also run with our filter"
    assert {cell.model_set for cell in noted("ground")} == {""}, "stored results of shipped robots stay"
    assert [cell.model_set for cell in noted("ground", mode="one-step")] == ["first", "first", ""]
    for cell in before:
        write(tmp_path, cell, {"study": configuration(cell), "model": None})
    in_use.version = "second"
    with pytest.raises(ResultError, match="another model_set"):
        read_result(tmp_path, noted(car)[0])
    assert read_result(tmp_path, noted(car)[2]) is not None
    with pytest.raises(ResultError, match=r"more than one model_set \(first, second\)"):
        noted(car, methods=("ddpc",), seeds=(1,))
    with pytest.raises(ResultError, match="is no longer first: run the comparison again"):
        before[0].run(tmp_path / "run")
    for cell in before:  # of a version that did not note the model set
        study = {name: value for name, value in configuration(cell).items() if name != "model_set"}
        write(tmp_path, cell, {"study": study, "model": None})
    for cell in before[:2]:
        with pytest.raises(ResultError, match="another model_set"):
            read_result(tmp_path, cell)
        with pytest.raises(ResultError, match=f"{cell.name} does not state the model set that filtered the robot"):
            stored_cells(tmp_path, car)
        result_path(tmp_path, cell).unlink()
    with pytest.raises(ResultError, match=r"sailr-s0\.json has no training"):  # and its model set is not asked for
        stored_cells(tmp_path, car)
    assert read_result(tmp_path, before[2]) is not None


def test_error_bounds_that_were_measured_on_another_recording_are_refused(data_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(compare_command, "complete", lambda *_: pytest.fail("a training began"))
    monkeypatch.setattr(model_store, "method_for", lambda *_: SimpleNamespace(version="1"))
    job, command = Conservatism("ground"), CompareCommand(("ground",), (0,), methods=("none",), results=tmp_path)
    digest = Dataset.load(record_path(GROUND)).steady().digest()
    for stored, accepted in ((digest, True), ("1ec1979cbe07", False)):
        write(tmp_path, job, {"study": configuration(job), "data": stored, "rows": []})
        with pytest.raises(pytest.fail.Exception if accepted else ResultError, match=r"began|on another recording"):
            command.run()
    for other in (replace(command, again=True), replace(command, conservatism=False)):
        with pytest.raises(pytest.fail.Exception, match="a training began"):
            other.run()


@pytest.mark.parametrize(
    "command, words",
    [
        (CompareCommand(table=True, seeds=(0,), engine=Engine(4)), "--table ignores --seeds, --workers or --ray"),
        (CompareCommand(table=True, tune=True), "--table ignores --tune"),
        (CompareCommand(tune=True, steps=100, task_settings=False), "--tune ignores --steps, --no-task-settings"),
        (CompareCommand(tune=True, quick=True), "--tune ignores --quick"),
        (CompareCommand(seeds=()), "give at least one of --seeds"),
        (CompareCommand(seeds=(0, -1)), "a seed is a number from 0 to 999999, not -1"),
        (CompareCommand(arenas=()), "at least one of the --arenas"),
        (CampaignCommand(episodes=0), "--episodes is a number from 1 on"),
        (CampaignCommand(search=-1), "--search a number from 0 on"),
        (CampaignCommand(arenas=()), "name at least one of the arenas"),
        (CampaignCommand(near=float("nan")), "--near is a distance from 0 m on, not nan"),
        (CollectCommand(trajectories=0), "--trajectories a number from 1 on"),
        (CollectCommand(seed=-1), "--seed is a number from 0 on"),
        (CollectCommand(out=Path("/")), "is a folder: give the path of a file"),
        (CollectCommand(first_flight=FirstFlightSettings(minutes=3.0)), "need --url"),
        (CollectCommand("quadrotor", url="udpin:0.0.0.0:1", trajectories=3), "--url ignores --trajectories"),
    ],
)
def test_options_that_make_no_sense_or_do_nothing_are_refused(command, words, monkeypatch):
    monkeypatch.setattr(compare_command, "complete", lambda *_: pytest.fail("a job began"))
    with pytest.raises(ValueError, match=words):
        command.run()


@pytest.mark.parametrize(("mode", "counted"), [("one-step", "10"), ("direct", "6")])
def test_a_cell_counts_the_recorded_periods_that_its_model_set_was_fitted_to(monkeypatch, mode, counted):
    """Mode one-step also uses the restless trajectories, which were left out of the count."""
    recorded = SimpleNamespace(periods=10, steady=lambda: SimpleNamespace(periods=6))
    monkeypatch.setattr(cell_run, "load_or_record", lambda robot: recorded)
    assert cell_run._cost(SimpleNamespace(model_config=ModelConfig(mode=mode)), GROUND)["samples"] == counted
