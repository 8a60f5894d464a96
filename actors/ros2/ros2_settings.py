"""Settings of the ROS 2 node that are options of its command. This module imports nothing that an extra brings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from brakeline.messaging.number_checks import check_most, check_numbers

if TYPE_CHECKING:
    from brakeline.actors.ros2.sensor_frames import PlanarPose


@dataclass(frozen=True)
class Topics:
    """Names of topics, below the namespace unless they begin with a slash."""

    odometry: str = "odom"
    """Read nav_msgs/Odometry from this topic."""
    scan: str = "scan"
    """Read sensor_msgs/LaserScan from this topic."""
    raw: str = "cmd_vel_raw"
    """Read the commands to filter from this topic."""
    command: str = "cmd_vel"
    """Send the filtered commands to this topic."""
    transforms: str = "/tf"
    """Read transforms from this topic."""
    fixed_transforms: str = "/tf_static"
    """Read transforms that never change from this topic."""
    diagnostics: str = "/diagnostics"
    """Send diagnostic_msgs/DiagnosticArray to this topic."""
    markers: str = "~/markers"
    """Send what the filter sees and plans to this topic, as visualization_msgs/MarkerArray."""


@dataclass(frozen=True)
class AgeLimits:
    """The greatest age [s] of each input; an older one counts as missing."""

    odometry: float = 0.15
    """Count odometry as missing if it is older than this [s]."""
    scan: float = 0.6
    """Count a scan as missing if its first beam is older than this [s]. That includes one turn of a slow lidar and the
    wait for the next scan."""
    command: float = 0.5
    """Count a command as missing if it is older than this [s]."""
    ahead: float = 0.05
    """Let a stamp be in the future by this much, because clocks differ [s]."""


@dataclass(frozen=True)
class SensorSettings:
    """How to interpret a robot's sensors."""

    range_error: float = 0.02  # m, the largest of the lidar
    zero_is_free: bool = False  # the lidar reports 0 where nothing is within its range
    least_width: float = 0.02  # m, of all obstacles: where beams have no information, see `unknown_space.py`
    free_at_start: float = 0.0  # m, radius of a disc about the robot that is free at the start; 0: nothing is known
    mount: PlanarPose | None = None  # the lidar's pose on the robot; None: the transforms contain it
    odometry_frame: str = "odom"  # the frame of the state
    base_frame: str = ""  # the robot's frame in the transforms, which then replace the odometry; empty: they do not

    def __post_init__(self) -> None:
        check_numbers(self, "range_error", "free_at_start", least=0.0)
        check_numbers(self, "least_width", above=0.0)
        check_most(self, "least_width", most=1.0)  # one in mm or cm would free nearly all unknown directions
        if self.mount is not None:
            check_numbers(self.mount, "x", "y", "yaw", "tilt")
            if abs(self.mount.yaw) > math.tau:  # all obstacles would be in another direction
                raise ValueError(f"the lidar's yaw is {self.mount.yaw:g} rad, more than a turn: give it in radians")
