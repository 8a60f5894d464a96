"""Named whole-system configurations, and a run's one resolved configuration as it is saved and read back."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from brakeline.actors.actor_settings import FlightSettings, PhysicsChange
from brakeline.learner.learner_config import LearnerConfig, TD3Config
from brakeline.logs.segment_rotation import Rotation
from brakeline.safety.model.model_config import METHODS as FILTERS
from brakeline.safety.model.model_config import ModelConfig
from brakeline.sim.sim_conditions import Conditions

METHODS = (*FILTERS, "none")


@dataclass(frozen=True)
class Embedded:
    """The simulated autopilot of a flight in real time."""

    rules: str = "px4"
    setpoint_timeout: float = 0.2  # s without a setpoint until it brakes


@dataclass(frozen=True)
class RunConfig:
    """Everything that a run depends on, besides the machine."""

    robots: tuple[str, ...] = ("ground",)
    method: str = "ddpc"
    model_config: ModelConfig = field(default_factory=ModelConfig)
    accept_bound: float | None = None  # the largest stated bound that is accepted; None: each robot's own limit
    arena: str = "default"
    actors: int = 2  # processes a robot kind
    robots_per_actor: int = 1  # robots in a process; they share a question to the safety service
    fleet: int = 0  # as many, if they share a world too
    steps: int = 100_000  # a robot kind
    seed: int = 0
    penalty: float = 1.0  # for a correction by the whole range of an input
    deadline: float = 0.1  # s for an answer of the safety service
    deterministic: bool = False  # one actor, lockstep, no deadlines
    from_logs: tuple[str, ...] = ()  # files or folders whose steps are learned from first; with no actor: only these
    replicas: int = 1  # of the safety service
    record: bool = True  # a log; without one nothing can be analysed or replayed
    rotation: Rotation = field(default_factory=Rotation)  # of the log's files
    pictures: float = 10.0  # a second and robot, drawn for Foxglove in the log; 0: none
    practice: float = 0.0  # share of steps at which a robot starts to follow its committed plan to the stop
    change: PhysicsChange = field(default_factory=PhysicsChange)  # of the robots, in mid-run
    conditions: Conditions = field(default_factory=Conditions)
    policy: str = ""  # a file or a name, as `evaluate` takes it; empty: one is learned
    flights: tuple[
        FlightSettings, ...
    ] = ()  # in real time behind links, an actor each; none: simulated as fast as it goes
    autopilot: Embedded | None = None  # that the run starts itself, at the other end of each link
    mavlink: bool = False  # every frame of quadrotors in memory into the log; those of a flight always are
    learner: LearnerConfig = field(default_factory=lambda: LearnerConfig(checkpoint_every=2500))

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"no method is called {self.method!r}; there are: {', '.join(METHODS)}")
        if (self.robots, self.arena) != (RunConfig.robots, RunConfig.arena):
            _check_arenas(self.robots, self.arena)
        if self.fleet:
            _check_fleets(self)
        if min(self.robots_per_actor, self.replicas, self.steps) < 1 or self.actors < (0 if self.from_logs else 1):
            raise ValueError(
                "actors (unless there are logs to learn from), robots per actor, replicas, steps: 1 or more"
            )
        if self.deterministic and self.from_logs:
            raise ValueError("a deterministic run learns from its own actor, not from logs")
        if self.deterministic and (self.actors != 1 or self.robots_per_actor != 1 or len(self.robots) != 1):
            raise ValueError("a deterministic run has one actor with one robot: --actors 1")
        if self.flights and (self.actors != len(self.flights) or self.robots_per_actor != 1 or len(self.robots) != 1):
            raise ValueError("flights in real time have one actor each, with one robot of one kind")

    @property
    def filtered(self) -> bool:
        """Is anybody asked before a robot acts? Offline there is no robot."""
        return self.method != "none" and self.actors > 0

    def learning(self) -> LearnerConfig:
        """The learner's part, with what it shares with the others."""
        return replace(self.learner, seed=self.seed, steps=self.steps, lockstep=self.deterministic)


def _check_arenas(robots: tuple[str, ...], arena: str) -> None:
    """Raises ValueError: a robot or its arena does not exist. Other than the defaults', which need no look: what
    `train --help` reads has no simulator to wait for."""
    from brakeline.messaging.task import robot_with_task
    from brakeline.sim.arena_generator import arena_kind

    kinds = [robot_with_task(robot) for robot in robots]
    for robot in kinds:
        arena_kind(robot, arena)
    if len({robot.name for robot in kinds}) < len(kinds):
        raise ValueError(f"each robot once, with one task: not {', '.join(robots)}")


def _check_fleets(config: RunConfig) -> None:
    """Raises NoFleet."""
    from brakeline.messaging.task import robot_with_task
    from brakeline.sim.shared_world import check_fleet

    for robot in config.robots:
        check_fleet(robot_with_task(robot), config.arena, config.fleet, config.conditions)


EXPERIMENTS: dict[str, RunConfig] = {
    "default": RunConfig(),
    "demo": RunConfig(steps=24_000),
    # Minutes of nothing: whole runs in the tests, with networks too small to learn much.
    "debug": RunConfig(
        steps=1_200,
        learner=LearnerConfig(
            td3=TD3Config(hidden=(32, 32), batch=32, warmup=200), checkpoint_every=400, capacity=5_000
        ),
    ),
}


# Names that fields had in older files.
FORMER = {"recipe": "model_config"}


def encode(config: Any) -> str:
    """JSON of a configuration."""
    return json.dumps(dataclasses.asdict(config), indent=2)


def decode(kind: type[Any], values: Any) -> Any:
    """The configuration (a dataclass, nested ones included) that `encode` wrote.

    Raises:
        ValueError: a field is unknown: the file is another version's.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{kind.__name__} is an object of named values, not {values!r}")
    hints = typing.get_type_hints(kind)
    values = {FORMER.get(name, name): value for name, value in values.items()}
    unknown = values.keys() - {f.name for f in dataclasses.fields(kind)}
    if unknown:
        raise ValueError(f"{kind.__name__} has no {', '.join(sorted(unknown))}: written by another version?")
    return kind(**{name: _value(hints[name], value) for name, value in values.items()})


def _value(hint: Any, value: Any) -> Any:
    if value is None:
        return None
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    if dataclasses.is_dataclass(hint):
        return decode(typing.cast(type[Any], hint), value)
    if typing.get_origin(hint) is tuple:
        (part, *_) = typing.get_args(hint)
        return tuple(decode(part, each) if isinstance(each, dict) else each for each in value)
    return Path(value) if hint is Path else value


def load(path: Path) -> RunConfig:
    """Raises ValueError, naming the file, when it is no run's configuration."""
    try:
        config: RunConfig = decode(RunConfig, json.loads(path.read_text()))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is no run's configuration: {error}") from error
    return config
