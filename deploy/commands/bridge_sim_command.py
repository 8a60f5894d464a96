"""Implement `brakeline bridge-sim`: simulate a ground robot as a ROS 2 robot."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import errors, print_counts
from brakeline.deploy.commands.ros2_command import GraphOptions, log_to_stderr, open_bag
from brakeline.messaging.stop_signals import stop_on_signals


@dataclass(frozen=True)
class BridgeSimCommand:
    """The options of `brakeline bridge-sim`."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Act as the Zenoh router at these endpoints."""
    router: tuple[str, ...] = ()
    """Connect to a running router of rmw_zenoh at these endpoints instead."""
    graph: options.Unprefixed[GraphOptions] = field(default_factory=GraphOptions)
    arena: options.ArenaName = "default"
    seed: options.Seed = 0
    sim_time: bool = False
    """Publish simulated time on /clock, instead of using the time of this machine."""
    factor: float = 1.0
    """With --sim-time, run at most at this multiple of real time. 0 runs as fast as possible."""
    lockstep: bool = False
    """With --sim-time, wait in each control period for its command, so that no command is late on a busy machine."""
    timeout: float = 0.3
    """Stop the base after this time without a command [s]."""
    stamped: bool = False
    """Expect TwistStamped commands."""
    physics: options.Unprefixed[options.PhysicsOptions] = field(default_factory=options.PhysicsOptions)
    bag: Path | None = None
    """Record all received and sent messages as a ROS 2 bag in this folder, which must not exist."""
    seconds: float = 0.0
    """Run for this long by the clock of the robot [s]. 0 runs until you press ^C."""
    json: options.Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "ros2")
    least: ClassVar[dict[str, float]] = {"seconds": 0, "factor": 0}
    above: ClassVar[dict[str, float]] = {"timeout": 0}

    def run(self) -> int:
        """Simulate until the duration ends, SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.deploy.run.ros2_bridge import Bridge, BridgeSettings

        if not self.sim_time and (self.lockstep or self.factor != 1.0):
            raise ValueError("--factor and --lockstep need simulated time: give --sim-time too")
        listen = () if self.router else self.listen
        ros = self.graph.settings(self.router, listen)
        settings = options.settings_from(BridgeSettings, self, ros=ros, conditions=self.physics.conditions())
        log_to_stderr("bridge-sim")
        with contextlib.ExitStack() as stack:
            bridge = Bridge(settings, stack.enter_context(open_bag(self.bag)))
            stack.callback(bridge.close)
            if not self.json:
                errors.print(f"ground on {', '.join(self.router or self.listen)}, {self.arena}; ^C ends it")
            bridge.run(stack.enter_context(stop_on_signals(threading.Event())))
        print_counts(asdict(bridge.outcome), self.json)
        return 0
