"""Implement `brakeline ros2`: filter the commands of a ROS 2 robot, without a ROS installation."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings, Topics
from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import print_counts
from brakeline.messaging.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from brakeline.actors.decision_guard import Ask
    from brakeline.logs.bag_writer import BagWriter
    from brakeline.messaging import brakeline_pb2 as pb
    from brakeline.messaging.robot import Robot
    from brakeline.messaging.ros2 import RosSettings

SERVICE_LEAD = 0.12  # s, default of --lead with --connect: an answer over the bus takes longer than one in process


@dataclass(frozen=True)
class GraphOptions:
    """Place the node in the ROS graph."""

    domain: int | None = None
    """Join this ROS domain. Defaults to $ROS_DOMAIN_ID, else to 0."""
    namespace: str = "/"
    """Put the node into this namespace."""

    def settings(self, connect: tuple[str, ...], listen: tuple[str, ...] = ()) -> RosSettings:
        """Return how to reach the graph at these endpoints. Raises ValueError: the domain is no whole number from 0."""
        from brakeline.messaging.ros2 import RosSettings

        text = os.environ.get("ROS_DOMAIN_ID") or "0" if self.domain is None else str(self.domain)
        if not text.isdecimal():
            name = "ROS_DOMAIN_ID" if self.domain is None else "--domain"
            raise ValueError(f"{name} is {text!r}: a ROS domain is a whole number from 0 on")
        return RosSettings(connect, listen, int(text), self.namespace)


@dataclass(frozen=True)
class Ros2Command:
    """The options of `brakeline ros2`."""

    least: ClassVar[dict[str, float]] = {"range_error": 0, "free_at_start": 0}
    above: ClassVar[dict[str, float]] = {"least_width": 0}

    robot: options.Robot = "ground"
    router: tuple[str, ...] = ("tcp/localhost:7447",)
    """Connect to the router of rmw_zenoh at these endpoints, as Zenoh writes them."""
    graph: options.Unprefixed[GraphOptions] = field(default_factory=GraphOptions)
    name: str = "brakeline"
    """Give the node this name."""
    topics: Topics = field(default_factory=Topics)
    stamped: bool = False
    """Expect and send TwistStamped commands, which are the default of Nav2 since Kilted."""
    sim_time: bool = False
    """Take the time from /clock."""
    lead: float | None = None
    """Decide an input this long before its control period [s]. Defaults to 0.04, or to 0.12 with --connect."""
    mount: tuple[float, float, float] | None = None
    """Place the lidar at this pose in the frame of the robot: x y yaw [m, rad]. Defaults to the pose in /tf_static."""
    range_error: float = SensorSettings.range_error
    """Assume that a range of the lidar is wrong by at most this [m]."""
    zero_is_free: bool = False
    """Read a range of 0 as free space: the driver of the lidar reports 0 where it sees nothing within its range."""
    least_width: float = SensorSettings.least_width
    """Assume that no obstacle is narrower than this where beams have no information [m]. With a larger value, the
    robot drives on with more of such beams."""
    free_at_start: float = 0.0
    """State that the space within this distance of the robot's origin is free at the start [m], for a lidar that does
    not see all round. Nothing may come into space that the lidar does not see. 0 states nothing."""
    tf: bool = False
    """Take the pose of the robot from /tf instead of odometry messages."""
    odometry_frame: str = SensorSettings.odometry_frame
    """Expect the odometry in this frame."""
    base_frame: str = "base_footprint"
    """With --tf, take this as the frame of the robot. The robot turns about its origin."""
    turn_aside: bool = False
    """Turn the robot towards the nearest free direction if an obstacle blocks its way, instead of stopping it."""
    fresh: options.Unprefixed[AgeLimits] = field(default_factory=AgeLimits)
    filtering: options.Unprefixed[options.ServiceOptions] = field(default_factory=options.ServiceOptions)
    connect: tuple[str, ...] = ()
    """Query the safety service on the bus at these endpoints. Without an endpoint, the filter runs in this process."""
    keys: Path | None = None
    """With --connect, use the keys of --client in this folder. Defaults to $BRAKELINE_KEYS, else to no keys."""
    client: str = "client"
    """Use this name on a bus with keys (see `brakeline keys`)."""
    bag: Path | None = None
    """Record all received and sent messages as a ROS 2 bag in this folder, which must not exist."""
    seconds: float = 0.0
    """Run for this long by the clock of the robot [s]. 0 runs until you press ^C."""
    json: options.Json = False

    @property
    def extras(self) -> tuple[str, ...]:
        """The optional parts that the command needs."""
        if not self.connect:
            return "sim", "ros2", "logs"
        return ("ros2", "logs") if self.bag else ("ros2",)

    def run(self) -> int:
        """Filter commands until the duration ends, SIGINT or SIGTERM. Returns the exit status."""
        from brakeline.actors.ros2.ros2_process import Ros2Settings, driven, run
        from brakeline.actors.ros2.sensor_frames import PlanarPose

        mount = PlanarPose(*self.mount) if self.mount else None
        settings = options.settings_from(
            Ros2Settings,
            self,
            ros=self.graph.settings(self.router),
            lead=self.lead or (SERVICE_LEAD if self.connect else Ros2Settings.lead),
            sensors=options.settings_from(
                SensorSettings, self, mount=mount, base_frame=self.base_frame if self.tf else ""
            ),
            age_limits=self.fresh,
        )
        log_to_stderr(self.name)
        with (
            self._asker(driven(self.robot), settings.lead) as asker,
            open_bag(self.bag) as bag,
            stop_on_signals(threading.Event()) as stop,
        ):
            figures = run(settings, asker, stop, bag)
        print_counts(figures, self.json)
        return 0

    @contextlib.contextmanager
    def _asker(self, robot: Robot, lead: float) -> Iterator[Ask]:
        """Yield the function that asks for decisions: in this process, or over the bus."""
        if not self.connect:
            from brakeline.deploy.data.model_store import model_for
            from brakeline.deploy.experiments.evaluate import in_process

            accept_bound = self.filtering.accept_bound
            yield in_process(model_for(robot, self.filtering.model_config(), accept_bound), accept_bound)
            return
        from brakeline.messaging.bus import Bus, BusSettings
        from brakeline.messaging.bus.identity import distinct_name
        from brakeline.safety.service.service_query import query_service

        deadline = 0.3 * lead  # a period may need three requests

        def ask_service(requests: Sequence[pb.Request]) -> list[pb.Reply]:
            return query_service(bus, requests, deadline)

        keys = self.keys or options.default_keys()
        # Several robots may have nodes with the default name, each in a namespace of its own.
        name = distinct_name(self.client) if keys or self.name == Ros2Command.name else self.name
        with Bus(BusSettings(connect=self.connect, keys=keys), name) as bus:
            yield ask_service


def open_bag(folder: Path | None) -> contextlib.AbstractContextManager[BagWriter | None]:
    """Open a ROS 2 bag to record into, if there is a folder."""
    if folder is None:
        return contextlib.nullcontext()
    from brakeline.logs.bag_writer import BagWriter

    return BagWriter(folder)


def log_to_stderr(name: str) -> None:
    """Write the log records of this process to stderr."""
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {name} %(levelname)s %(message)s")
