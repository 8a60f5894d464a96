"""`brakeline evaluate`: run a policy through the filter, in process, on fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import ActorIdentity, EpisodeRunner, RobotGroup, run_episode
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.vehicle_factory import environment
from brakeline.logs.episode_stats import EpisodeStats, closed_loop
from brakeline.logs.log_analysis import perception_in
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.task import RobotWithTask
from brakeline.safety.methods import Model
from brakeline.safety.model.model_config import DDPC, check_reservations
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts
from brakeline.sim.scripted_policies import Policy
from brakeline.sim.shared_world import FleetEnv
from brakeline.sim.sim_conditions import Conditions

FRESH = 1_000_000  # added to the seed, so that no training run has the same episodes


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
    accept_bound: float | None = None  # the largest stated bound that is accepted; None: the robot's own limit


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


def episode(driver: EpisodeRunner, policy: Policy, question: Ask | None, number: int) -> Iterator[pb.Step]:
    """Yield the steps of one episode of a robot that is alone."""
    for (step,) in run_episode(RobotGroup([driver]), [policy], question, number):
        yield step


def prepare_evaluation(robot: RobotWithTask, what: Evaluation) -> tuple[EpisodeRunner, Policy, Ask | None]:
    """Create the episode runner in a fresh environment, the policy, and the filter's function (None: no filter)."""
    policy = policy_named(what.policy, robot, what.seed)
    env = environment(robot, what.arena, FRESH + what.seed, what.conditions)
    question = _question(robot, what)
    driver = EpisodeRunner(robot, env, ActorIdentity("evaluate", 0, what.seed), filtered=question is not None)
    return driver, policy, question


def prepare_fleet(robot: RobotWithTask, what: Evaluation) -> tuple[RobotGroup, FleetEnv, list[Policy], Ask | None]:
    """Create the group, the world, the policies and the filter's function for several robots in one world.

    Raises:
        NoFleet: this robot or this arena has no fleet.
        ValueError: this method supports no reservations.
    """
    check_reservations(what.method)
    world = FleetEnv(robot, what.arena, what.fleet, FRESH + what.seed, what.conditions)
    policies = [policy_named(what.policy, robot, what.seed + i) for i in range(what.fleet)]
    question = _question(robot, what)
    drivers = [
        EpisodeRunner(robot, member, ActorIdentity(f"evaluate.{i}", i, what.seed), filtered=question is not None)
        for i, member in enumerate(world.members)
    ]
    return RobotGroup(drivers, world, question is not None), world, policies, question


def _question(robot: RobotWithTask, what: Evaluation) -> Ask | None:
    """Return the function that asks the filter, or None for the method `none`."""
    if what.method == "none":
        return None
    return in_process(method_for(robot, what.method, what.model_config, what.accept_bound), what.accept_bound)


def evaluate(
    robot: RobotWithTask, what: Evaluation, each: Callable[[EpisodeStats], Any] = lambda stats: None
) -> dict[str, Any]:
    """Run `what.episodes` episodes and return their closed-loop metrics.

    A fleet runs at least that many episodes, counted over all its robots; its metrics are also given by kind, by robot,
    and for its worlds. The function calls `each` after every episode with the statistics so far.
    """
    world: FleetEnv | None = None
    if what.fleet:
        group, world, policies, question = prepare_fleet(robot, what)
    else:
        driver, policy, question = prepare_evaluation(robot, what)
        group, policies = RobotGroup([driver]), [policy]
    stats = {runner.identity.actor: EpisodeStats() for runner in group.runners}
    rounds, periods = -(-what.episodes // len(stats)), 0
    for number in range(rounds):
        for steps in run_episode(group, policies, question, number):
            periods += 1
            for step in steps:
                stats[step.actor].step(step)
        for actor in stats.values():
            each(actor)
    figures = closed_loop(stats.values())
    if world is not None:
        seconds = periods * robot.period
        figures |= {
            "robots": {robot.name: dict(figures)},
            "actors": {name: closed_loop([actor]) for name, actor in stats.items()},
            "worlds": {
                "count": rounds,
                "robot_steps": periods * what.fleet,  # includes robots that stand at their goals
                "touches": world.touches,  # contacts between two robots, for any reason
                "goals_per_minute": 60.0 * figures["goals"] / seconds if seconds else None,
            },
        }
    filtered = what.method == DDPC
    return figures | {
        "method": what.method,
        "certificate": what.model_config.certificate if filtered else None,
        "mode": what.model_config.mode if filtered else None,
        "policy": what.policy,
        "arena": what.arena,
        "perception": perception_in(what.conditions.describe()),
        "seed": what.seed,
        "conditions": what.conditions.describe(),
    }
