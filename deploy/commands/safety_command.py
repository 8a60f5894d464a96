"""Implement `brakeline safety`: run a safety service alone."""

from __future__ import annotations

from contextlib import ExitStack
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

    robots: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT ...]")] = ("ground",)
    """Serve these robots. Give their names, or paths of robot descriptions (.toml)."""
    endpoints: Unprefixed[BusOptions] = field(default_factory=BusOptions)
    filtering: Unprefixed[ServiceOptions] = field(default_factory=ServiceOptions)
    name: str = "safety"
    """Give the service this name on the bus. Each replica needs its own."""
    adapt: bool = False
    """Certify a robot anew while it drives. If the filter widens the sets of the robot for some time, a certifier
    process fits a model set to the last minutes and puts it to use. The certifier learns from the steps that `brakeline
    actor` publishes on the bus; programs with a `SafetyClient` and `brakeline ros2` publish none. The certifier needs
    the keys of `certify` in --keys. Give this option to one replica."""

    def run(self) -> int:
        """Answer requests until SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.deploy.run.run_keys import check_adaptable, check_signer
        from brakeline.deploy.run.run_models import signed_last
        from brakeline.safety.service.server import SafetySettings, main
        from brakeline.safety.service.signature import TrustedSigners

        model_config, accept_bound = self.filtering.model_config(), self.filtering.accept_bound
        robots = [robot_maybe_with_task(robot) for robot in self.robots]
        bus = self.endpoints.bus()
        if self.adapt:
            check_signer(bus.keys)
        trust = None if bus.keys is None else TrustedSigners.load(bus.keys)
        paths = []
        for robot in robots:
            path = method_path(robot, self.filtering.method, model_config)
            if trust is None:
                model = method_for(robot, self.filtering.method, model_config, accept_bound)
            else:  # a model that this service built would have no signature
                path = signed_last(path, data_root(), robot.name, trust, model_config.mode)
                model = trust.load_model(path)
            if self.adapt:
                check_adaptable(model)
            paths.append(path)
        limits = {robot.name: robot.accept_bound for robot in robots}
        with ExitStack() as beside:
            if self.adapt:
                from brakeline.deploy.run.adaptation_process import CertifierSettings, certifier_beside

                beside.enter_context(certifier_beside(CertifierSettings(bus, self.robots, data_root(), accept_bound)))
            main(SafetySettings(bus, tuple(paths), data_root(), self.name, limits, accept_bound))
        return 0
