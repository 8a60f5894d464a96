"""Define the configuration of a run, the named experiments, and how a configuration is saved and loaded."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import tyro

from brakeline.actors.actor_settings import FlightSettings, PhysicsChange
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.logs.segment_rotation import Rotation
from brakeline.messaging.number_checks import check_numbers
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.model.model_config import AUTO, DDPC, ModelConfig
from brakeline.safety.model.model_config import METHODS as FILTERS
from brakeline.sim.sim_conditions import Conditions

METHODS = (*FILTERS, "none")
BATCH: Literal["batch"] = "batch"  # the backend that simulates all robots in the learner's process
MOST_IN_PROCESS = 64  # robots for which the access list lets a process publish, and requests of a batch
FORMER_NAMES = {"recipe": "model_config"}  # names that fields have in older files

T = TypeVar("T")
SEEDS = 1_000_000  # number of seeds of trainings; evaluations and tunings draw their episodes from larger ones
Internal = Annotated[T, tyro.conf.Suppress]  # a field that commands set from other options, or by themselves


@dataclass(frozen=True)
class AutopilotConfig:
    """The simulated autopilot of a flight in real time."""

    rules: str = "px4"
    setpoint_timeout: float = 0.2  # s without a setpoint after which the autopilot brakes


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run depends on, besides the machine. `brakeline train` makes its options from these fields.

    Raises ValueError if the values contradict each other.
    """

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}  # for this and all nested dataclasses

    robots: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT ...]")] = ("ground",)
    """Train these robots. Give their names, or paths of robot descriptions (.toml). Each has a learner and actors of
    its own; all share the safety service."""
    method: Internal[str] = "ddpc"
    model_config: Internal[ModelConfig] = field(default_factory=lambda: ModelConfig(mode=AUTO))
    accept_bound: Internal[float | None] = None  # largest accepted stated bound; None: the limit of each description
    arena: str = "default"
    """Drive in arenas of this name. `brakeline robot check ROBOT` lists those of a robot."""
    backend: Literal["processes", "batch"] = "processes"
    """Simulate in actor processes, or all robots at once (batch: many more steps a second)."""
    actors: int = 2
    """Run this many actor processes for each robot kind. You may give 0 with --from-logs."""
    robots_per_actor: int = 1
    """Run this many robots in each actor process. They share one request to the safety service. With --backend batch,
    run this many in all, by default 32."""
    fleet: int = 0
    """Let this many robots of each actor process share one world and avoid each other. 0 gives each robot a world of
    its own."""
    steps: int = 100_000
    """Train for this many steps of each robot kind."""
    seed: int = 0
    """Draw everything random in the run from this seed."""
    penalty: float | None = None
    """Subtract this penalty from the learner's reward if the filter corrects an input by its whole range. Defaults to
    the one in the robot's task."""
    deadline: float = 0.1
    """Let an actor wait this long for an answer of the safety service [s]. Then its robot brakes along its backup
    plan."""
    deterministic: bool = False
    """Run one actor in lockstep without deadlines: the same seed gives the same weights, bit for bit."""
    from_logs: tuple[str, ...] = ()
    """Let the learner take the steps of these logs (files or run folders) before any robot starts. With --actors 0 it
    learns from them alone. With --resume the logs replace a lost checkpoint."""
    replicas: int = 1
    """Run this many safety service processes. The robots drive on if one of several processes fails."""
    record: bool = True
    """Record a log. Without a log you can't analyse, replay or certify the run."""
    rotation: Rotation = field(default_factory=Rotation)
    """Begin the next file of the log after this size or duration."""
    pictures: float = 10.0
    """Draw this many pictures a second of each robot into the log for Foxglove, and up to as many of each kind of
    intervention. 0 draws none at all."""
    practice: float = 0.0
    """At this share of the steps, let a robot begin to follow its backup plan to the stop. The log then has the stops
    that `brakeline certify ROBOT --data LOG` needs."""
    change: PhysicsChange = field(default_factory=PhysicsChange)
    """Change the robots or the floor in the middle of the run, such as --change.after 5000 --change.payload-kg 1."""
    adapt: bool = False
    """Certify a robot anew while it drives. If the robot needs wider sets than its model set states for some time, a
    certifier process fits a model set to the last minutes and puts it to use. --practice is then 0.01, unless you give
    it."""
    conditions: Internal[Conditions] = field(default_factory=Conditions)
    policy: Internal[str] = ""  # a name or a file, as `evaluate` takes it; empty: the run learns a policy
    flights: Internal[tuple[FlightSettings, ...]] = ()  # links to vehicles in real time, one for each actor
    autopilot: Internal[AutopilotConfig | None] = None  # that the run starts at the other end of each link
    mavlink: bool = False
    """Log each MAVLink frame of simulated quadrotors, as bytes and as JSON. This about doubles the size of the log.
    Flights in real time always log them."""
    learner: LearnerConfig = field(default_factory=lambda: LearnerConfig(checkpoint_every=2500))
    """Configure the learner and its algorithm (TD3)."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"no method is called {self.method!r}; there are: {', '.join(METHODS)}")
        if (self.robots, self.arena) != (RunConfig.robots, RunConfig.arena):
            _check_arenas(self.robots, self.arena)
        if not 0 <= self.seed < SEEDS:
            raise ValueError(f"a seed is a number from 0 to {SEEDS - 1}, not {self.seed}: evaluations have larger ones")
        if self.fleet:
            _check_fleets(self)
        if min(self.robots_per_actor, self.replicas, self.steps) < 1 or self.actors < (0 if self.from_logs else 1):
            raise ValueError(
                "actors (unless there are logs to learn from), robots per actor, replicas, steps: 1 or more"
            )
        if self.robots_per_actor > MOST_IN_PROCESS:
            more = "" if self.backend == BATCH else ", and give more --actors"
            raise ValueError(
                f"a process has at most {MOST_IN_PROCESS} robots, not {self.robots_per_actor}, with any method: it may "
                f"publish under the names of so many. Lower --robots-per-actor{more}"
            )
        check_numbers(self, "deadline", above=0.0)
        check_numbers(self, "practice", "pictures", least=0.0)
        if self.penalty is not None:
            from brakeline.messaging.task import check_penalty, robot_with_task

            for robot in self.robots:
                check_penalty(self.penalty, robot_with_task(robot))
        if self.adapt and self.method != DDPC:
            raise ValueError(f"--adapt certifies model sets of the method {DDPC}, not of {self.method}")
        if self.backend == BATCH:
            _check_batch(self)
        one_robot = self.robots_per_actor == 1 and len(self.robots) == 1
        if self.deterministic and self.from_logs:
            raise ValueError("a deterministic run learns from its own actor, not from logs: leave out --from-logs")
        if self.deterministic and not (self.actors == 1 and one_robot):
            raise ValueError("a deterministic run has one actor with one robot: --actors 1")
        if self.flights and not (self.actors == len(self.flights) and one_robot):
            raise ValueError("each flight in real time has one actor with one robot, all of one kind")

    @property
    def filtered(self) -> bool:
        """Whether robots act, and a filter checks their actions. Learning from logs alone moves no robot."""
        return self.method != "none" and self.actors > 0

    def learning(self) -> LearnerConfig:
        """Return the learner's configuration, with the seed, steps and lockstep of the run."""
        return replace(self.learner, seed=self.seed, steps=self.steps, lockstep=self.deterministic)


def _check_arenas(robots: tuple[str, ...], arena: str) -> None:
    """Check that the robots and their arena exist. Raises ValueError.

    The caller skips the default robot and arena, so that the experiments of this module cost no time.
    """
    from brakeline.messaging.task import arena_kind, robot_with_task

    kinds = [robot_with_task(robot) for robot in robots]
    for robot in kinds:
        arena_kind(robot, arena)
    if len({robot.name for robot in kinds}) < len(kinds):
        raise ValueError(f"each robot once, with one task: not {', '.join(robots)}")


def _check_batch(config: RunConfig) -> None:
    """Check that a batch can do what the run asks for. Raises ValueError, or NoBatch if the robot can't be batched."""
    refused = {
        "more than one robot kind": len(config.robots) > 1,
        f"the method {config.method}": config.method not in (DDPC, "none"),
        "--fleet": config.fleet > 0,
        "--from-logs": bool(config.from_logs),
        "--adapt": config.adapt,
        "--practice": config.practice > 0.0,
        "--change": config.change.after >= 0,
        "--mavlink": config.mavlink,
        "--deterministic (a batch is repeatable as it is)": config.deterministic,
        "a policy that does not learn": bool(config.policy),
        "flights in real time": bool(config.flights),
    }
    for what, given in refused.items():
        if given:
            raise ValueError(f"--backend batch does not support {what}: leave it out, or use --backend processes")
    from brakeline.messaging.task import robot_with_task
    from brakeline.sim.batch.batch_support import check_batch

    check_batch(robot_with_task(config.robots[0]), config.arena, config.conditions)


def _check_fleets(config: RunConfig) -> None:
    """Check that the robots can share a world. Raises NoFleet."""
    from brakeline.messaging.task import robot_with_task
    from brakeline.sim.shared_world import check_fleet

    for robot in config.robots:
        check_fleet(robot_with_task(robot), config.arena, config.fleet, config.conditions)


BATCH_ROBOTS = 32

EXPERIMENTS: dict[str, RunConfig] = {
    "default": RunConfig(),
    "demo": RunConfig(steps=24_000),
    # For tests of whole runs: ends within minutes, with networks that are too small to learn much.
    "debug": RunConfig(
        steps=1_200,
        learner=LearnerConfig(
            td3=TD3Config(hidden=(32, 32), batch=32, warmup=200), checkpoint_every=400, capacity=5_000
        ),
    ),
}


def in_batches(config: RunConfig) -> RunConfig:
    """Return an experiment with the backend batch, and without pictures of its many robots."""
    return replace(config, backend=BATCH, robots_per_actor=BATCH_ROBOTS, actors=1, pictures=0.0)


def encode(config: RunConfig) -> str:
    """Return a configuration as JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2)


def decode(text: str) -> RunConfig:
    """Return the configuration that `encode` wrote, now or in an older version.

    Raises ValueError if the text is no JSON, a field is unknown or a value is not allowed.
    """
    from pydantic import TypeAdapter, ValidationError  # here, so that `--help` does not wait for it

    values: Any = parse_json(text)
    if isinstance(values, dict):
        values = {FORMER_NAMES.get(name, name): value for name, value in values.items()}
    try:
        return TypeAdapter(RunConfig).validate_python(values)
    except ValidationError as error:
        problems = (f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in error.errors())
        raise ValueError("; ".join(problem.removeprefix(": ") for problem in problems)) from error


def load(path: Path) -> RunConfig:
    """Load the configuration of a run from a file. Raises ValueError, which names the file."""
    try:
        return decode(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is no run's configuration: {error}") from error
