"""Implement `brakeline safety`: run a safety service alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from brakeline.deploy.commands.common_options import BusOptions, ServiceOptions, Unprefixed
from brakeline.deploy.data.data_paths import data_root, method_path
from brakeline.deploy.data.model_store import method_for
from brakeline.messaging.task import robot_maybe_with_task


@dataclass(frozen=True)
class SafetyCommand:
    """The options of `brakeline safety`."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ("ground",)
    """Robots to serve: names, or paths of robot descriptions (.toml)."""
    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    filtering: Unprefixed[ServiceOptions] = field(default_factory=ServiceOptions)
    name: str = "safety"
    """Name of the service on the bus. Each replica needs its own."""

    def run(self) -> int:
        """Answer requests until SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.safety.service.server import SafetySettings, main

        model_config, accept_bound = self.filtering.model_config(), self.filtering.accept_bound
        robots = [robot_maybe_with_task(robot) for robot in self.robots]
        for robot in robots:
            method_for(robot, self.filtering.method, model_config, accept_bound)
        paths = tuple(method_path(robot, self.filtering.method, model_config) for robot in robots)
        limits = {robot.name: robot.accept_bound for robot in robots}
        main(SafetySettings(self.endpoints.bus(), paths, data_root(), self.name, limits, accept_bound))
        return 0
