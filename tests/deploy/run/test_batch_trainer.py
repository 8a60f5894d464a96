"""Training from a batch: repeatable by its seed, every step filtered and told, resumed without losses."""

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.actors.actor_settings import PhysicsChange
from brakeline.deploy.commands.learner_command import LearnerCommand
from brakeline.deploy.commands.train_command import TrainCommand
from brakeline.deploy.run.batch_trainer import BatchTrainer
from brakeline.deploy.run.processes import process_specs
from brakeline.deploy.run.run_config import BATCH, RunConfig, in_batches
from brakeline.errors import BadRequest, NoBatch, UnknownTask
from brakeline.learner.learner import Learner
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.task import robot_with_task
from brakeline.safety.filter.batch.row_by_row import RowByRow
from brakeline.safety.filter.filter import Filter
from brakeline.safety.rivals.sailr import Sailr
from brakeline.sim.scripted_policies import GroundGreedyPolicy
from tests.safety.rivals.test_sailr import known
from tests.system.runs import Run

GROUND = robot_with_task("ground")
SAFETY = Filter.load("ground")
SIZE, PERIODS = 6, 40
SMALL = TD3Config(hidden=(16, 16), batch=16, warmup=90, updates_per_step=0.25)
CONFIG = LearnerConfig(td3=SMALL, steps=10_000, publish_every=5)


class Told:
    """What the robots of a trainer publish."""

    def __init__(self) -> None:
        self.steps: list[pb.Step] = []
        self.episodes: list[pb.Episode] = []

    def __call__(self, number: int, message: pb.Step | pb.Episode) -> None:
        assert message.actor == f"learner.{number}"
        (self.steps if isinstance(message, pb.Step) else self.episodes).append(message)  # type: ignore[arg-type]


def trained(learner=None, safety=SAFETY, periods=PERIODS, seed=0, **options) -> tuple[Learner, Told]:
    learner, told = learner or Learner(GROUND, replace(CONFIG, seed=seed)), Told()
    trainer = BatchTrainer(learner, safety, SIZE, "learner", told, seed=seed, **options)
    for _ in range(periods):
        trainer.period()
    trainer.close()
    return learner, told


def successive(steps: list[pb.Step]) -> Iterator[tuple[pb.Step | None, pb.Step]]:
    """Yield each step with the step before it of the same robot, None for the first one."""
    last = dict[str, pb.Step]()
    for step in steps:
        yield last.get(step.actor), step
        last[step.actor] = step


@pytest.fixture(scope="module")
def run() -> tuple[Learner, Told]:
    return trained()


def test_the_seed_determines_the_weights_and_every_step(run: tuple[Learner, Told]) -> None:
    learner, told = run
    assert learner.updates > 30
    again, other = trained(), trained(seed=1)
    assert again[0].weights() == learner.weights() and other[0].weights() != learner.weights()
    for step, same in zip(told.steps, again[1].steps, strict=True):
        step.decide_ms = same.decide_ms = 0.0
        assert step == same


def test_every_step_is_filtered_learned_and_published_once(run: tuple[Learner, Told]) -> None:
    learner, told = run
    assert learner.steps == len(told.steps) == SIZE * PERIODS
    metrics = learner.metrics()
    assert (metrics.duplicates, metrics.missing, metrics.refused) == (0, 0, 0)
    begun = {(episode.actor, episode.episode): episode for episode in told.episodes}
    assert len(begun) == len(told.episodes) >= SIZE
    for step in told.steps:
        assert begun[step.actor, step.episode].seed == step.episode * 4096 + int(step.actor.rpartition(".")[2])
        assert step.decision and not step.fallback and not step.collision
        assert len(step.observation) == 26 and len(step.path) == 20 and step.header.time > 0.0
    kinds = Counter(step.decision for step in told.steps)
    assert kinds[pb.ALLOWED] > 50 and kinds[pb.ADJUSTED] > 5
    corrected = [step for step in told.steps if step.decision == pb.ADJUSTED]
    assert all(step.penalty > 0.0 for step in corrected)
    compared = [step for step in told.steps if step.compared]
    assert np.mean([step.contained for step in compared]) > 0.97
    assert {step.weights_version for step in told.steps} > {1, 2}


def test_consecutive_steps_of_a_robot_continue_each_other_over_the_ends_of_episodes() -> None:
    """The last step of an episode belongs to that episode, although the next one has begun when it is published."""
    learner, told = Learner(GROUND, CONFIG), Told()
    trainer = BatchTrainer(learner, SAFETY, SIZE, "learner", told)
    greedy, ended = GroundGreedyPolicy(GROUND, np.random.default_rng(0)), 0
    trainer._propose = lambda: np.array([greedy(None, info) for info in infos(trainer)])  # type: ignore
    for _ in range(70):
        trainer.period()
    trainer.close()
    assert (learner.metrics().duplicates, learner.metrics().missing) == (0, 0)
    for before, step in successive(told.steps):
        assert step.index == (1 if before is None else before.index + 1)
        if before is not None and before.episode == step.episode:
            assert step.observation == before.next_observation and step.step == before.step + 1
        elif before is not None:
            assert (before.terminated or before.truncated) and step.episode == before.episode + 1
            assert step.step == 0 and before.goal
            ended += 1
    assert ended >= 1 and all(learner.metrics().limit[actor] >= 70 for actor in trainer.actors)


def test_in_sailrs_training_an_intervention_ends_the_robots_episode() -> None:
    """As with one robot: the step is the last one, and its reward less its penalty is the lowest."""
    learner, told = trained(safety=RowByRow(Sailr(known(threshold=0.6))), ends_on_intervention=True)
    assert (learner.metrics().duplicates, learner.metrics().missing) == (0, 0)
    begun = {(episode.actor, episode.episode) for episode in told.episodes}
    for before, step in successive(told.steps):
        assert step.cut == (step.decision == pb.FAILSAFE) and (step.actor, step.episode) in begun
        if step.cut:
            assert step.truncated and step.reward - step.penalty == pytest.approx(GROUND.task.reward.cut)
        else:
            assert step.penalty == 0.0 and step.decision == pb.ALLOWED
        if before is not None:
            continues = not (before.terminated or before.truncated)
            following = (before.episode, before.step + 1) if continues else (before.episode + 1, 0)
            assert (step.episode, step.step) == following
            assert not continues or step.observation == before.next_observation
    cut = sum(step.cut for step in told.steps)
    assert 5 < cut < len(told.steps) / 2


def test_a_correction_costs_what_the_task_says_unless_an_option_says_otherwise() -> None:
    """All runs have the same inputs: random ones, since the learner warms up."""

    def penalties(cost: float, **options: float) -> list[float]:
        task = replace(GROUND.task, reward=replace(GROUND.task.reward, correction_penalty=cost))
        learner = Learner(replace(GROUND, task=task), replace(CONFIG, td3=replace(SMALL, warmup=10_000)))
        return [step.penalty for step in trained(learner, **options)[1].steps]

    once = np.array(penalties(1.0))
    assert once.any() and penalties(2.0) == pytest.approx(2.0 * once)
    assert penalties(2.0, penalty=3.0) == pytest.approx(3.0 * once)


def test_without_a_filter_each_robot_executes_what_it_proposes() -> None:
    _, told = trained(safety=None, periods=3)
    for step in told.steps:
        assert step.action == pytest.approx(list(step.proposed)) and not step.decision and not step.penalty


def infos(trainer: BatchTrainer) -> list[dict[str, Any]]:
    """Return what a scripted policy needs of each robot."""
    env = trainer._robots._env
    return [{"state": state, "goal": goal} for state, goal in zip(env._robots.measured, env._goals, strict=True)]


def test_a_resumed_run_goes_on_with_the_next_episodes(tmp_path: Path) -> None:
    learner, _ = trained(periods=20)
    learner.save(tmp_path)
    resumed = Learner(GROUND, CONFIG)
    resumed.restore(tmp_path)
    _, told = trained(resumed, periods=20)
    assert resumed.steps == 2 * 20 * SIZE and resumed.metrics().duplicates == 0
    assert resumed.metrics().missing == 0
    assert min(episode.episode for episode in told.episodes) == 1


def test_all_robots_brake_while_the_filter_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """They brake along their committed plans, the steps say so, and the filter goes on when it can."""
    told = Told()
    trainer = BatchTrainer(Learner(GROUND, CONFIG), SAFETY, SIZE, "learner", told)
    for _ in range(3):
        trainer.period()

    def fail(requests: Any) -> None:
        raise BadRequest("state", "row 0: not finite")

    with monkeypatch.context() as broken:
        broken.setattr(Filter, "decide_batch", lambda self, requests: fail(requests))
        for _ in range(4):
            trainer.period()
    trainer.period()
    trainer.close()
    failed = told.steps[3 * SIZE : 7 * SIZE]
    assert all(step.fallback and step.decision == pb.FAILSAFE for step in failed)
    assert not any(any(step.action) for step in failed[-SIZE:])
    assert not any(step.fallback or step.collision for step in told.steps[-SIZE:])


def test_a_state_that_is_not_finite_costs_its_robot_one_decision_and_one_step() -> None:
    """It cost all robots their decisions, and ended the training."""
    learner, told = Learner(GROUND, CONFIG), Told()
    trainer = BatchTrainer(learner, SAFETY, SIZE, "learner", told)
    for period in range(5):
        if period == 3:
            trainer._robots._filtered._infos["state"][2, 0] = trainer._robots.observations[2, 0] = np.nan
        trainer.period()
    trainer.close()
    assert [i for i, step in enumerate(told.steps) if step.fallback] == [3 * SIZE + 2]
    assert (learner.steps, learner.rejected) == (5 * SIZE - 1, 1)


def test_the_backend_has_settings_of_its_own_which_options_change() -> None:
    config = TrainCommand.defaults(["ground", "--backend", "batch", "--experiment=debug"])
    assert (config.backend, config.robots_per_actor, config.experiment) == (BATCH, 32, "debug")
    debug = config.learner.td3
    assert debug.updates_per_step < 1.0 and (debug.hidden, debug.warmup) == ((32, 32), 200)
    for robot, hidden, warmup in (("ground", (128, 128), 500), ("quadrotor", (256, 256), 2000), ("?", (128, 128), 500)):
        td3 = TrainCommand.defaults(["--backend", "batch", robot]).learner.td3
        assert td3.hidden == hidden and td3.warmup == warmup
    assert TrainCommand.defaults(["--backend=batch"]).backend == BATCH
    assert TrainCommand.defaults([]).backend == "processes"
    assert [spec.name for spec in process_specs(in_batches(RunConfig()))] == ["recorder", "learner"]


def test_a_task_has_settings_for_its_learner_which_options_change(tmp_path: Path) -> None:
    def imitation(*words: str) -> float:
        return TrainCommand.defaults(list(words)).learner.td3.imitation

    task = robot_with_task("quadrotor").task.learner
    assert imitation("quadrotor") == imitation("--backend", "batch", "quadrotor") == task["imitation"] > 0.0
    assert LearnerCommand.defaults(["quadrotor"]).learner.td3.penalty_growth == task["penalty_growth"] > 1.0
    assert imitation() == imitation("ground") == LearnerCommand.defaults([]).learner.td3.imitation == 0.0
    assert imitation("quadrotor", "ground") == 0.0  # only one of the tasks asks for it
    shutil.copy(ROBOTS_FOLDER / "ground.toml", tmp_path)
    shipped = (ROBOTS_FOLDER / "ground.task.toml").read_text()
    for wrong, said in (
        ("rate = 1.0", "no setting rate"),
        ("imitation = -1", "imitation"),
        ("tau = 'x'", "'tau': 'x'"),
    ):
        (tmp_path / "ground.task.toml").write_text(f"{shipped}[learner]\n{wrong}\n")
        with pytest.raises(ValueError, match=said):
            imitation(str(tmp_path / "ground.toml"))
    for wrong in ("learner = 3", 'like = "ground"', "[learner"):  # the run itself complains
        (tmp_path / "ground.task.toml").write_text(wrong)
        assert imitation(str(tmp_path / "ground.toml"), "x" * 5000, "\0") == 0.0
        with pytest.raises(UnknownTask, match="is no task"):
            robot_with_task(str(tmp_path / "ground.toml"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"method": "secas"}, "the method secas"),
        ({"adapt": True}, "--adapt"),
        ({"practice": 0.1}, "--practice"),
        ({"change": PhysicsChange(after=5)}, "--change"),
        ({"robots": ("ground", "quadrotor")}, "more than one robot kind"),
        ({"robots_per_actor": 65}, "at most 64"),
    ],
)
def test_what_a_batch_does_not_do_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(in_batches(RunConfig()), **changes)
    with pytest.raises(NoBatch, match="moving obstacles"):
        replace(in_batches(RunConfig()), robots=("quadrotor",), arena="traffic")


@pytest.mark.long
def test_a_whole_run_is_logged_and_analysed_as_others(data_folder: Path, tmp_path: Path) -> None:
    command = ("train", "ground", "--backend", "batch", "--experiment", "debug")
    with Run(tmp_path / "run", "--steps", 1500, command=command) as run:
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    assert figures["finished"] and 1500 <= figures["steps"] <= 1536 and figures["collisions"] == 0
    assert figures["log_messages"]["missing"] == 0 and figures["learners"]["ground"]["steps"] == 1500
    assert (run.folder / "learner" / "policy.safetensors").is_file()
