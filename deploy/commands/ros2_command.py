"""`brakeline ros2` and `brakeline bridge-sim`: robots of a ROS 2 graph, without ROS installed."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from brakeline.actors.decision_guard import Ask
from brakeline.actors.ros2.ros2_process import Ros2Settings, Topics, driven, run
from brakeline.actors.ros2.ros_inputs import AgeLimits, SensorSettings
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.deploy.commands.common_options import Flags, Physics, Robot, Serving, default_keys, errors, say_json
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.run.ros2_bridge import Bridge, BridgeSettings
from brakeline.logs.bag_writer import BagWriter
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.ros2 import ROUTER, RosSettings
from brakeline.messaging.stop_signals import stop_on_signals
from brakeline.safety.service.client import query_service


@dataclass(frozen=True)
class Graph:
    """Where the ROS graph is."""

    domain: int = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    """ROS domain; default: $ROS_DOMAIN_ID, else 0."""
    namespace: str = "/"


@dataclass(frozen=True)
class Ros2:
    robot: Robot = "ground"
    router: tuple[str, ...] = (ROUTER,)
    """rmw_zenoh's router, as Zenoh writes endpoints."""
    graph: Flags[Graph] = field(default_factory=Graph)
    name: str = "brakeline"
    """Of the node."""
    topics: Topics = field(default_factory=Topics)
    stamped: bool = False
    """Commands are TwistStamped, in and out (the default of Nav2 since Kilted)."""
    sim_time: bool = False
    """Live by /clock."""
    lead: float | None = None
    """s before a period at which its input is decided on; default: 0.04, with --connect 0.12."""
    mount: tuple[float, float, float] | None = None
    """x y yaw of the lidar in the robot's frame [m, rad]; without: as /tf_static says."""
    range_error: float = SensorSettings.range_error
    """m, of a lidar's range, at most."""
    zero_is_free: bool = False
    """The lidar's driver reports 0 where it sees nothing within its range."""
    tf: bool = False
    """Take the robot's pose from /tf instead of odometry messages."""
    odometry_frame: str = SensorSettings.odometry_frame
    base_frame: str = "base_footprint"
    """With --tf: the robot's; its origin is what turns on the spot."""
    fresh: Flags[AgeLimits] = field(default_factory=AgeLimits)
    filtering: Flags[Serving] = field(default_factory=Serving)
    connect: tuple[str, ...] = ()
    """Ask the safety service on the bus there; without: the filter runs inside."""
    keys: Path | None = None
    """With --connect: folder with the keys of --client; default: $BRAKELINE_KEYS, else none."""
    client: str = "client"
    """Its name on a bus with keys (`brakeline keys`)."""
    bag: Path | None = None
    """Record everything heard and sent as a ROS 2 bag: a folder that is not there yet."""
    seconds: float = 0.0
    """By the robot's clock, until it ends; 0: on ^C."""
    json: bool = False

    def run(self) -> int:
        settings = Ros2Settings(
            robot=self.robot,
            ros=RosSettings(self.router, domain=self.graph.domain, namespace=self.graph.namespace),
            name=self.name,
            topics=self.topics,
            stamped=self.stamped,
            sim_time=self.sim_time,
            lead=self.lead or (0.12 if self.connect else Ros2Settings.lead),
            sensing=SensorSettings(
                self.range_error,
                self.zero_is_free,
                PlanarPose(*self.mount) if self.mount else None,
                self.odometry_frame,
                self.base_frame if self.tf else "",
            ),
            fresh=self.fresh,
            seconds=self.seconds,
        )
        log_to_stderr(self.name)
        with self._question(settings) as question, self._tap() as tap, stop_on_signals(threading.Event()) as stop:
            figures = run(settings, question, stop, tap)
        if self.json:
            say_json(figures)
        else:
            errors.print(", ".join(f"{name} {value:g}" for name, value in figures.items()))
        return 0

    @contextlib.contextmanager
    def _question(self, settings: Ros2Settings) -> Iterator[Ask]:
        robot = driven(self.robot)
        if not self.connect:
            accepted = self.filtering.accept_bound
            yield in_process(model_for(robot, self.filtering.model_config(), accepted), accepted)
            return
        deadline = 0.3 * settings.lead  # there may be three questions

        def question(requests: Sequence[pb.Request]) -> list[pb.Reply]:
            return query_service(bus, requests, deadline)

        keys = self.keys or default_keys()
        with Bus(BusSettings(connect=self.connect, keys=keys), self.client if keys else self.name) as bus:
            yield question

    @contextlib.contextmanager
    def _tap(self) -> Iterator[BagWriter | None]:
        if self.bag is None:
            yield None
        else:
            with BagWriter(self.bag) as bag:
                yield bag


@dataclass(frozen=True)
class BridgeSim:
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Be the Zenoh router there."""
    router: tuple[str, ...] = ()
    """Connect to this router instead: rmw_zenoh's, where it runs."""
    graph: Flags[Graph] = field(default_factory=Graph)
    arena: str = "default"
    """Drawn with the seed."""
    seed: int = 0
    sim_time: bool = False
    """Its own time on /clock, instead of this machine's."""
    factor: float = 1.0
    """With --sim-time: of real time, at most; 0: as fast as it goes."""
    lockstep: bool = False
    """With --sim-time: each period waits for its command, so that nothing is late on a busy machine."""
    timeout: float = BridgeSettings.timeout
    """s without a command until the base stops by itself."""
    stamped: bool = False
    """Commands are TwistStamped."""
    physics: Flags[Physics] = field(default_factory=Physics)
    bag: Path | None = None
    """Record everything heard and sent as a ROS 2 bag: a folder that is not there yet."""
    seconds: float = 0.0
    """Of its time, until it ends; 0: on ^C."""
    json: bool = False

    def run(self) -> int:
        """Raises ValueError when the clock's options do not fit together."""
        if not self.sim_time and (self.lockstep or self.factor != 1.0):
            raise ValueError("--factor and --lockstep need a time of its own: --sim-time")
        settings = BridgeSettings(
            ros=RosSettings(self.router, () if self.router else self.listen, self.graph.domain, self.graph.namespace),
            arena=self.arena,
            seed=self.seed,
            sim_time=self.sim_time,
            factor=self.factor,
            lockstep=self.lockstep,
            timeout=self.timeout,
            stamped=self.stamped,
            seconds=self.seconds,
            conditions=self.physics.conditions(),
        )
        log_to_stderr("bridge-sim")
        with contextlib.ExitStack() as stack:
            bag = stack.enter_context(BagWriter(self.bag)) if self.bag is not None else None
            bridge = Bridge(settings, bag)
            stack.callback(bridge.close)
            if not self.json:
                errors.print(f"ground on {', '.join(self.router or self.listen)}, {self.arena}; ^C ends it")
            bridge.run(stack.enter_context(stop_on_signals(threading.Event())))
        figures = bridge.outcome.figures()
        if self.json:
            say_json(figures)
        else:
            errors.print(", ".join(f"{name} {value:g}" for name, value in figures.items()))
        return 0


def log_to_stderr(name: str) -> None:
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {name} %(levelname)s %(message)s")
