"""`brakeline safety | learner | actor | recorder`: each process alone, on any machine."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import tyro

from brakeline.deploy.commands.common_options import Endpoints, Filtering, Flags, Flight, Physics, Robot, Serving
from brakeline.deploy.data.data_paths import data_root, method_path
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.run.run_config import RunConfig
from brakeline.learner.learner_config import LearnerConfig
from brakeline.logs.segment_rotation import Rotation
from brakeline.messaging.task import address, address_in_real_time, robot_maybe_with_task, robot_with_task
from brakeline.safety.model.model_config import check_reservations


@dataclass(frozen=True)
class Safety:
    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ("ground",)
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    filtering: Flags[Serving] = field(default_factory=Serving)
    name: str = "safety"
    """On the bus; replicas need different ones."""

    def run(self) -> int:
        from brakeline.safety.service.server import SafetySettings, main

        model_config, accepted = self.filtering.model_config(), self.filtering.accept_bound
        robots = [robot_maybe_with_task(robot) for robot in self.robots]
        for robot in robots:
            method_for(robot, self.filtering.method, model_config, accepted)
        paths = tuple(method_path(robot, self.filtering.method, model_config) for robot in robots)
        limits = {robot.name: robot.accept_bound for robot in robots}
        main(SafetySettings(self.endpoints.bus(), paths, data_root(), self.name, limits, accepted))
        return 0


@dataclass(frozen=True)
class LearnerProcess:
    robot: Robot = "ground"
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    out: Path = Path("runs/learner")
    """Folder of its checkpoint and policy."""
    resume: bool = False
    """From the checkpoint there."""
    resume_if_any: bool = False
    """From the checkpoint there, if there is one: for who starts it again and again."""
    name: str = "learner"
    seed: int = 0
    steps: int = 100_000
    learner: LearnerConfig = field(default_factory=lambda: RunConfig().learner)

    def run(self) -> int:
        from brakeline.learner.checkpoint import CHECKPOINT, exists
        from brakeline.learner.learner_process import LearnerSettings, main

        resume = self.resume or (self.resume_if_any and exists(self.out / CHECKPOINT))
        config = replace(self.learner, seed=self.seed, steps=self.steps)
        main(LearnerSettings(self.endpoints.bus(), address(self.robot), self.out, resume, self.name, config))
        return 0


@dataclass(frozen=True)
class Actor:
    robot: Robot = "ground"
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    filtering: Flags[Filtering] = field(default_factory=Filtering)
    physics: Flags[Physics] = field(default_factory=Physics)
    name: str = f"actor-{os.uname().nodename.split('.')[0]}"
    """On the bus; every actor of a run needs its own."""
    number: int = 0
    """Of its first robot in the run: two robots of one number and seed see the same episodes."""
    robots: int = 1
    """In this process; their requests share a question."""
    fleet: int = 0
    """So many robots in this process and in one world; 0: each is alone in its own."""
    seed: int = 0
    arena: str = "default"
    penalty: float = RunConfig.penalty
    deadline: float = RunConfig.deadline
    """s, for an answer of the safety service; then the robot brakes along its plan."""
    policy: str = ""
    """A file (weights, or inputs that `excite` printed), or trained | untrained | random | greedy | adversary | astar |
    careful; without one: a learner's weights."""
    steps: int = 0
    """With a policy: until it ends; 0: on ^C."""
    mavlink: bool = False
    """Have every MAVLink frame of quadrotors in memory logged too; with --url they always are."""
    url: str = ""
    """Fly a quadrotor in real time behind udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT, on the arena's map as it
    is drawn with the seed. The safety service must know quadrotor-late."""
    flight: Flags[Flight] = field(default_factory=Flight)

    def run(self) -> int:
        from brakeline.actors.actor_process import ActorSettings, run

        at = address_in_real_time(self.robot) if self.url else address(self.robot)
        robot = robot_with_task(at)
        if self.fleet:
            check_reservations(self.filtering.method)
        settings = ActorSettings(
            bus=self.endpoints.bus(),
            robot=at,
            name=self.name,
            number=self.number,
            robots=self.fleet or self.robots,
            fleet=self.fleet > 0,
            seed=self.seed,
            arena=self.arena,
            method=self.filtering.method,
            penalty=self.penalty,
            deadline=self.deadline,
            mavlink=self.mavlink,
            steps=self.steps,
        )
        propose = partial(policy_named, self.policy, robot) if self.policy else None
        about = self.physics.conditions()
        if self.url:
            from brakeline.actors import flight_process as flight
            from brakeline.deploy.quadrotor_vehicles import flight_arena

            arena = flight_arena(self.arena, self.seed)
            flight.run(settings, self.flight.settings(self.url, arena), arena, propose, about)
        else:
            from brakeline.deploy.vehicle_factory import environment, fleet_world

            worlds = partial(fleet_world, conditions=about)
            run(settings, partial(environment, conditions=about), propose, worlds)
        return 0


@dataclass(frozen=True)
class Recorder:
    log: Annotated[Path, tyro.conf.Positional] = Path("runs/run.mcap")
    """File to write; if it exists, the next segment."""
    endpoints: Flags[Endpoints] = field(default_factory=Endpoints)
    name: str = "recorder"
    pictures: float = RunConfig.pictures
    """A second and robot, drawn for Foxglove in the log besides all interventions; 0: none at all."""
    rotation: Rotation = field(default_factory=Rotation)

    def run(self) -> int:
        from brakeline.deploy.run.mavlink_json import as_json, both
        from brakeline.logs import recorder
        from brakeline.logs.foxglove import FoxgloveConverter

        about = {"versions": {"brakeline": version("brakeline")}}
        derive = both(FoxgloveConverter(self.pictures).from_sample, as_json) if self.pictures > 0.0 else as_json
        recorder.main(self.endpoints.bus(), self.log, about, self.name, derive=derive, rotation=self.rotation)
        return 0
