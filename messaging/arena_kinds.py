"""The arenas of a task: the distributions from which obstacles, moving obstacles, starts and goals are drawn."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ConfigDict

from brakeline.messaging.number_checks import check_numbers, check_ranges, check_sizes

_STRICT = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class MoverKind:
    """Moving obstacles of an arena, and the errors with which a sensor measures them."""

    __pydantic_config__ = _STRICT
    count: tuple[int, int]  # (least, most)
    radius: float  # of a disc in the plane, of a ball in space [m]
    speed: float  # largest [m/s]
    acceleration: float  # largest [m/s²]
    keep: float  # least distance from the robot's start to the surface, when an episode begins [m]
    position_error: float = 0.03  # [m]
    velocity_error: float = 0.05  # [m/s]
    steps_over: bool = False  # True: passes over a standing robot, which then continues; False: the episode ends

    def __post_init__(self) -> None:
        check_ranges(self, "count")
        check_numbers(self, "radius", above=0.0)
        check_numbers(self, "speed", "acceleration", "keep", "position_error", "velocity_error", least=0.0)


@dataclass(frozen=True)
class ArenaKind:
    """Distribution from which arenas of one name are drawn. Pairs are (least, most)."""

    __pydantic_config__ = _STRICT
    half_width: float  # [m]
    cylinders: tuple[int, int]
    radius: tuple[float, float]  # of a cylinder [m]
    boxes: tuple[int, int]
    edge: tuple[float, float]  # of a box [m]
    square: bool  # boxes have two equal edges
    gap: float  # least gap between obstacles in plan view, walls included, beyond the robot's diameter [m]
    path_clearance: float  # clearance beyond the footprint along at least one path from start to goal [m]
    goal_distance: float  # least distance from the start [m]
    step_limit: int
    start_clearance: float = 0.1  # clearance beyond the footprint at the start and at the goal [m]
    goal_radius: float = 0.25  # [m]
    height: float | None = None  # from floor to ceiling [m]; None: an arena in the plane
    tall: tuple[float, float] = (0.0, 0.0)  # height of a box in space [m]
    spheres: tuple[int, int] = (0, 0)
    ball: tuple[float, float] = (0.0, 0.0)  # radius of a sphere [m]
    movers: MoverKind | None = None
    ring: float | None = None  # radius of a circle with starts and, opposite, goals, so that paths cross [m]

    def __post_init__(self) -> None:
        check_numbers(self, "half_width", "goal_distance", "goal_radius", "height", "ring", above=0.0)
        check_numbers(self, "gap", "path_clearance", "start_clearance", least=0.0)
        check_numbers(self, "step_limit", least=1)
        check_ranges(self, "cylinders", "boxes", "spheres")
        check_sizes(self, radius=self.cylinders, edge=self.boxes, ball=self.spheres)
        check_sizes(self, tall=(0, 0) if self.height is None else self.boxes)
