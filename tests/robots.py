"""The robots that most tests are about."""

from brakeline.messaging.task import RobotWithTask, robot_with_task

GROUND = robot_with_task("ground")
QUADROTOR = robot_with_task("quadrotor")
ROBOTS: dict[str, RobotWithTask] = {robot.name: robot for robot in (GROUND, QUADROTOR)}
