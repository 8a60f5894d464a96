"""The robots that most tests are about."""

from messaging.robots import Robot, robot_named

GROUND = robot_named("ground")
QUADROTOR = robot_named("quadrotor")
ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (GROUND, QUADROTOR)}
