"""`brakeline evaluate`: drive fresh episodes with a policy behind the filter, without a bus."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner, RobotGroup, run_episode
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.experiments.episode_table import COLUMNS, EpisodeTable
from brakeline.deploy.experiments.task_engine import Engine, Say, unsaid
from brakeline.deploy.policy_loading import file_named, policy_named
from brakeline.deploy.run.run_config import SEEDS
from brakeline.deploy.vehicle_factory import environment
from brakeline.errors import BadModel, Mismatch
from brakeline.logs.episode_stats import EpisodeStats, closed_loop
from brakeline.logs.log_analysis import perception_in
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import acceleration_age_in
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.methods import Model
from brakeline.safety.model.model_config import DDPC, check_reservations
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.rivals.own_code import OwnCode
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from brakeline.sim.scripted_policies import Policy
from brakeline.sim.shared_world import FleetEnv
from brakeline.sim.sim_conditions import Conditions

FRESH = SEEDS  # added to the seed, so that no training run has the same episodes
EPISODES_A_PART = 100  # a part of an evaluation, which another process may run
EPISODES_OF_A_BATCH = 1000  # the same for a batch, which waits for its last episodes at the end of a part
POLICY_SEEDS = 1_000  # from an episode's number to the seed of a scripted policy
ROWS = {name: column for name, column in COLUMNS.items() if name != "milliseconds"}  # of each episode; times differ

AfterEpisode = Callable[[EpisodeStats], Any]
Backend = Literal["single", "batch"]


@dataclass(frozen=True)
class Evaluation:
    """The settings of one evaluation."""

    policy: str = "astar"  # a file, or trained | untrained | random | greedy | adversary | astar
    method: str = "ddpc"
    model_config: ModelConfig = field(default_factory=ModelConfig)
    arena: str = "default"
    episodes: int = 100
    seed: int = 0
    conditions: Conditions = field(default_factory=Conditions)
    fleet: int = 0  # robots in one world; 0: each episode's robot is alone
    backend: Backend = "single"  # batch: many robots at once, each alone (deploy/experiments/batch_evaluation.py)
    accept_bound: float | None = None  # the largest stated bound that is accepted; None: the robot's own limit

    def __post_init__(self) -> None:
        if self.episodes < 1 or not 0 <= self.seed < SEEDS or self.fleet < 0:
            raise ValueError(
                f"an evaluation has at least 1 episode, a seed from 0 to {SEEDS - 1} and a fleet of at least 0 robots, "
                f"not {self.episodes}, {self.seed} and {self.fleet}"
            )


def in_process(model: Model, accept_bound: float | None = None) -> Ask:
    """Return a function that calls the core of the safety service directly.

    Requests and replies have the same bytes as on the bus.

    Raises:
        TooLoose: the model set's validation report is looser than the robot's limit, or than `accept_bound`.
    """
    models = ModelRegistry(accept_bound=accept_bound)
    models.install(model)
    return asking(models)


def asking(models: ModelRegistry) -> Ask:
    """Return a function that asks the core of the safety service with these models, in the bytes of the bus."""
    answer = BatchHandler(models, ServiceCounts())

    def ask(requests: Sequence[pb.Request]) -> list[pb.Reply]:
        payload = pb.RequestBatch(requests=requests).SerializeToString()
        return list(pb.ReplyBatch.FromString(answer(payload)).replies)

    return ask


def prepare_evaluation(
    robot: RobotWithTask, evaluation: Evaluation, first: int = 0
) -> tuple[EpisodeRunner, Policy, Ask | None]:
    """Create the episode runner in a fresh environment, the policy, and the filter's function (None: no filter).

    first: number of the first episode, which decides about the seed of scripted policies.
    """
    policy = policy_named(evaluation.policy, robot, evaluation.seed + POLICY_SEEDS * first)
    env = environment(robot, evaluation.arena, FRESH + evaluation.seed, evaluation.conditions)
    ask = _ask_for(robot, evaluation)
    driver = EpisodeRunner(robot, env, ActorIdentity("evaluate", 0, evaluation.seed), filtered=ask is not None)
    return driver, policy, ask


def prepare_fleet(
    robot: RobotWithTask, evaluation: Evaluation, first: int = 0
) -> tuple[RobotGroup, FleetEnv, list[Policy], Ask | None]:
    """Create the group, the world, the policies and the filter's function for several robots in one world.

    first: see `prepare_evaluation`.

    Raises:
        NoFleet: this robot or this arena has no fleet.
        ValueError: this method supports no reservations.
    """
    check_reservations(evaluation.method)
    world = FleetEnv(robot, evaluation.arena, evaluation.fleet, FRESH + evaluation.seed, evaluation.conditions)
    policies = [
        policy_named(evaluation.policy, robot, evaluation.seed + POLICY_SEEDS * first + i)
        for i in range(evaluation.fleet)
    ]
    ask = _ask_for(robot, evaluation)
    drivers = [
        EpisodeRunner(robot, member, ActorIdentity(f"evaluate.{i}", i, evaluation.seed), filtered=ask is not None)
        for i, member in enumerate(world.members)
    ]
    return RobotGroup(drivers, world, ask is not None), world, policies, ask


def _ask_for(robot: RobotWithTask, evaluation: Evaluation) -> Ask | None:
    """Return the function that asks the filter, or None for the method `none`."""
    model = model_of(robot, evaluation)
    if model is None:
        return None
    ask = in_process(model, evaluation.accept_bound)
    return _raising(ask, evaluation.method) if isinstance(model, OwnCode) else ask


def _raising(ask: Ask, method: str) -> Ask:
    """Return a function that raises BadModel if a filter of your own fails. A service would reply with the error."""

    def raising(requests: Sequence[pb.Request]) -> list[pb.Reply]:
        replies = ask(requests)
        if failed := [reply.error for reply in replies if reply.HasField("error")]:
            raise BadModel(f"{method} failed: {failed[0].type}: {failed[0].message}")
        return replies

    return raising


def model_of(robot: RobotWithTask, evaluation: Evaluation) -> Model | None:
    """Return the model of an evaluation's method, or None for the method `none`.

    Raises:
        Mismatch: the model set needs older accelerations than the simulator reports. Its robot would stand still.
        BadModel, TooLoose: see `method_for`.
    """
    if evaluation.method == "none":
        return None
    model = method_for(robot, evaluation.method, evaluation.model_config, evaluation.accept_bound)
    if (age := acceleration_age_in(model.about)) and not evaluation.conditions.learned:
        raise Mismatch(
            f"the model set of {robot.name} was recorded with the horizontal acceleration of {age:g} s ago, and the "
            "simulator reports the present one: drive the model set itself (`brakeline evaluate --learned`), or the "
            "real robot (`brakeline fly`)"
        )
    return model


@dataclass(frozen=True)
class DrivenEpisodes:
    """What was counted in some episodes of an evaluation.

    Attributes:
        stats: statistics by actor.
        periods: control periods.
        touches: contacts between two robots, for any reason.
        rows: figures of each episode by name, in the order in which the episodes began (`EpisodeTable.columns`).
    """

    stats: dict[str, EpisodeStats]
    periods: int
    touches: int
    rows: dict[str, list[float]]


@dataclass(frozen=True)
class EvaluationPart:
    """Some episodes of an evaluation, as a task of `deploy/experiments/task_engine.py`.

    Attributes:
        robot_with_task: the robot.
        evaluation: the whole evaluation.
        first, rounds: number of its first episode (of a fleet: of its first world), and how many there are.
        policy_file: content of the policy's file, if the policy is one. Another machine may not have it.
    """

    robot_with_task: RobotWithTask
    evaluation: Evaluation
    first: int
    rounds: int
    policy_file: bytes | None

    @property
    def robot(self) -> str:
        return self.robot_with_task.name

    @property
    def name(self) -> str:
        return f"episodes from {self.first}"

    def run(self, folder: Path, say: Callable[[str], object]) -> DrivenEpisodes:
        """Drive the episodes in a process of their own."""
        evaluation = self.evaluation
        if self.policy_file is not None:
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"policy{Path(evaluation.policy).suffix}"  # the name of a run's folder may be `.`
            path.write_bytes(self.policy_file)
            evaluation = replace(evaluation, policy=str(path))
        return replace(self, evaluation=evaluation).drive(lambda stats: say(progress_line(stats)))

    def drive(self, after_episode: AfterEpisode) -> DrivenEpisodes:
        """Drive the episodes. Calls `after_episode` after every one with the statistics so far."""
        robot, evaluation, world = self.robot_with_task, self.evaluation, None
        if evaluation.backend == "batch":
            return self._drive_batch(after_episode)
        if evaluation.fleet:
            group, world, policies, ask = prepare_fleet(robot, evaluation, self.first)
        else:
            driver, policy, ask = prepare_evaluation(robot, evaluation, self.first)
            group, policies = RobotGroup([driver]), [policy]
        stats, table = {runner.identity.actor: EpisodeStats() for runner in group.runners}, EpisodeTable(ROWS)
        periods = 0
        for number in range(self.first, self.first + self.rounds):
            for steps in run_episode(group, policies, ask, number):
                periods += 1
                for step in steps:
                    stats[step.actor].step(step)
                    table.step(step)
            for actor in stats.values():
                after_episode(actor)
        return DrivenEpisodes(stats, periods, 0 if world is None else world.touches, table.columns())

    def _drive_batch(self, after_episode: AfterEpisode) -> DrivenEpisodes:
        from brakeline.deploy.experiments.batch_evaluation import drive_batch

        stats: defaultdict[str, EpisodeStats] = defaultdict(EpisodeStats)
        table = EpisodeTable(ROWS)

        def take(step: pb.Step) -> None:
            stats[step.actor].step(step)
            table.step(step)
            if step.terminated or step.truncated:
                after_episode(stats[step.actor])

        drive_batch(self.robot_with_task, self.evaluation, self.first, self.rounds, take)
        return DrivenEpisodes(dict(stats), sum(one.steps for one in stats.values()), 0, table.columns())


def progress_line(stats: EpisodeStats) -> str:
    """Return what the statistics have counted, in a few words."""
    return f"goals {stats.goals}, collisions {stats.collisions}, interventions {stats.interventions}"


def parts_of(robot: RobotWithTask, evaluation: Evaluation) -> list[EvaluationPart]:
    """Cut an evaluation into parts, the same ones whatever runs them, for they decide about its figures.

    A part begins as an evaluation does: without a widening, and with a seed of its own for scripted policies. Written
    inputs are one sequence, and stay one part. A fleet drives at least `evaluation.episodes` episodes, counted over
    all its robots.
    """
    rounds = -(-evaluation.episodes // max(evaluation.fleet, 1))
    size = EPISODES_OF_A_BATCH if evaluation.backend == "batch" else EPISODES_A_PART
    size = max(rounds, 1) if evaluation.policy.endswith(".csv") else size
    path = file_named(evaluation.policy, robot)
    content = path.read_bytes() if path is not None and path.is_file() else None
    firsts = range(0, rounds, size)
    return [EvaluationPart(robot, evaluation, first, min(size, rounds - first), content) for first in firsts]


def evaluate(
    robot: RobotWithTask, evaluation: Evaluation, after_episode: AfterEpisode = lambda stats: None
) -> dict[str, Any]:
    """Run `evaluation.episodes` episodes in this process, and return their closed-loop metrics.

    `by_episode` has a list for each figure of `ROWS`, in the order of the episodes. A fleet has none.

    The metrics of a fleet are also given by kind, by robot, and for its worlds. The function calls
    `after_episode` after every episode with the statistics of its part (`parts_of`) so far.
    """
    return _figures(robot, evaluation, [part.drive(after_episode) for part in parts_of(robot, evaluation)])


def evaluate_with(engine: Engine, robot: RobotWithTask, evaluation: Evaluation, say: Say = unsaid) -> dict[str, Any]:
    """Return the same metrics as `evaluate`, by several processes or machines. say: see `Engine.completed`."""
    parts = parts_of(robot, evaluation)
    with TemporaryDirectory() as folder:
        driven = {part.first: counted for part, counted in engine.completed(parts, Path(folder), say)}
    return _figures(robot, evaluation, [driven[part.first] for part in parts])


def _figures(robot: RobotWithTask, evaluation: Evaluation, parts: Sequence[DrivenEpisodes]) -> dict[str, Any]:
    """Return the metrics of all parts of an evaluation, in the order of their episodes."""
    by_actor: dict[str, list[EpisodeStats]] = {}
    for part in parts:
        for actor, stats in part.stats.items():
            by_actor.setdefault(actor, []).append(stats)
    figures = closed_loop(stats for part in parts for stats in part.stats.values())
    if evaluation.fleet:
        periods = sum(part.periods for part in parts)
        seconds = periods * robot.period
        figures |= {
            "robots": {robot.name: dict(figures)},
            "actors": {name: closed_loop(stats) for name, stats in by_actor.items()},
            "worlds": {
                "count": sum(part.rounds for part in parts_of(robot, evaluation)),
                "robot_steps": periods * evaluation.fleet,  # includes robots that stand at their goals
                "touches": sum(part.touches for part in parts),
                "goals_per_minute": 60.0 * figures["goals"] / seconds if seconds else None,
            },
        }
    else:
        figures["by_episode"] = {name: [value for part in parts for value in part.rows[name]] for name in ROWS}
    filtered, model = evaluation.method == DDPC, model_of(robot, evaluation)
    return figures | {
        "method": evaluation.method,
        "model": None if model is None else model.version,
        "certificate": evaluation.model_config.certificate if filtered else None,
        "mode": evaluation.model_config.mode if filtered else None,
        "policy": evaluation.policy,
        "arena": evaluation.arena,
        "perception": perception_in(evaluation.conditions.describe()),
        "seed": evaluation.seed,
        "backend": evaluation.backend,
        "conditions": evaluation.conditions.describe(),
    }
