"""Implement `brakeline actor`: run one actor process alone."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.policy_loading import policy_named
from brakeline.deploy.run.run_config import RunConfig
from brakeline.messaging.task import address, address_in_real_time, robot_with_task
from brakeline.safety.model.model_config import check_reservations


@dataclass(frozen=True)
class ActorCommand:
    """The options of `brakeline actor`."""

    robot: options.Robot = "ground"
    endpoints: options.Unprefixed[options.BusOptions] = field(default_factory=options.BusOptions)
    filtering: options.Unprefixed[options.FilterOptions] = field(default_factory=options.FilterOptions)
    physics: options.Unprefixed[options.SimulationOptions] = field(default_factory=options.SimulationOptions)
    name: str = f"actor-{os.uname().nodename.split('.')[0]}"
    """Give the actor this name on the bus. Each actor of a run needs its own."""
    number: int = 0
    """Number the robots of this process from this number on. Robots with the same number and seed see the same
    episodes."""
    robots: int = 1
    """Run this many robots in this process. They share one request to the safety service."""
    fleet: int = 0
    """Run this many robots that share one world and avoid each other. 0 gives each robot a world of its own."""
    seed: options.Seed = 0
    arena: options.ArenaName = "default"
    penalty: float | None = RunConfig.penalty
    """Subtract this penalty from the learner's reward if the filter corrects an input by its whole range. Defaults to
    the one in the robot's task."""
    deadline: float = RunConfig.deadline
    """Wait this long for an answer of the safety service [s]. Then the robot brakes along its backup plan."""
    policy: str = ""
    """Follow this policy: trained, untrained, random, greedy, adversary, astar, careful, a weights file, or a CSV file
    of inputs as `brakeline excite` prints them. Defaults to the weights that a learner publishes."""
    steps: int = 0
    """With --policy, take this number of steps. 0 runs until you press ^C."""
    mavlink: bool = False
    """Log each MAVLink frame of simulated quadrotors too. With --url the actor always logs them."""
    url: str = ""
    """Fly the vehicle behind this link in real time: udpin:HOST:PORT, udpout:HOST:PORT or tcp:HOST:PORT. The map is the
    arena drawn with the seed. The safety service must serve quadrotor-late."""
    flight: options.Unprefixed[options.FlightOptions] = field(default_factory=options.FlightOptions)

    least: ClassVar[dict[str, float]] = {"number": 0, "fleet": 0, "steps": 0, "robots": 1}
    above: ClassVar[dict[str, float]] = {"deadline": 0}

    @property
    def extras(self) -> tuple[str, ...]:
        """The optional parts that the command needs."""
        return ("sim", "mavlink") if self.url else ("sim",)

    def run(self) -> int:
        """Act until the last step, SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.actors.actor_process import ActorSettings, run

        robot_address = address_in_real_time(self.robot) if self.url else address(self.robot)
        robot = robot_with_task(robot_address)
        if self.fleet:
            check_reservations(self.filtering.method)
        settings = options.settings_from(
            ActorSettings,
            self,
            bus=self.endpoints.bus(),
            robot=robot_address,
            robots=self.fleet or self.robots,
            fleet=self.fleet > 0,
            method=self.filtering.method,
        )
        propose = partial(policy_named, self.policy, robot) if self.policy else None
        conditions = self.physics.conditions()
        if self.url:
            from brakeline.actors import flight_process as flight
            from brakeline.deploy.quadrotor_vehicles import flight_arena

            arena = flight_arena(self.arena, self.seed)
            flight.run(settings, self.flight.settings(self.url, arena), arena, propose, conditions)
        else:
            from brakeline.deploy.vehicle_factory import environment, fleet_world

            worlds = partial(fleet_world, conditions=conditions)
            run(settings, partial(environment, conditions=conditions), propose, worlds)
        return 0
