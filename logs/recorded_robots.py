"""Look up the robots that the messages of a log or a run name."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

from brakeline.errors import UnknownRobot
from brakeline.messaging.robot import Robot, refuse_shipped_name, shipped_robots
from brakeline.messaging.robot_description import robot_from_description
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX
from brakeline.messaging.structured_text import parse_json
from brakeline.messaging.task import robot_with_task

log = logging.getLogger("brakeline.logs")


class RecordedRobots:
    """Robots by name: those that the log describes and those that come with the program, with their default tasks."""

    def __init__(self, robots: Iterable[Robot] = ()) -> None:
        self._robots = {robot.name: robot for robot in robots}

    def describe(self, descriptions: Mapping[str, str]) -> None:
        """Add the robots that a log's metadata describe. A malformed description is skipped with a warning."""
        for name, text in descriptions.items():
            try:
                robot = refuse_shipped_name(robot_from_description(parse_json(text), f"the log's {name}"))
            except ValueError as error:
                log.warning("%s", error)
                continue
            if robot.name not in shipped_robots():
                self._robots.setdefault(robot.name, robot)

    def named(self, name: str) -> Robot | None:
        """Return the robot with this name, or None. A name comes from a message, so it is never used as a path."""
        if name not in self._robots and (robot := self._lookup(name)) is not None:
            self._robots[name] = robot
        return self._robots.get(name)

    def _lookup(self, name: str) -> Robot | None:
        base = name.removesuffix(REAL_TIME_SUFFIX)
        robot = self._robots.get(base)
        if robot is None and base in shipped_robots():
            robot = robot_with_task(base)
        if robot is None or base == name:
            return robot
        try:
            return robot.in_real_time()
        except UnknownRobot:
            return None
