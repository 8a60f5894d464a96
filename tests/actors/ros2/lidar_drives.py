"""Drives of a simulated robot whose lidar sees a sector or has masked directions, through the node's parts, in process.

Inputs and gate are those of `FilterNode`, in the same order; the clock is the simulation's. No message crosses a bus.
"""

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from brakeline.actors.decision_guard import Ask
from brakeline.actors.ros2.command_gate import CommandGate
from brakeline.actors.ros2.ros2_settings import AgeLimits, SensorSettings
from brakeline.actors.ros2.ros_inputs import RosInputs
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.errors import InputMissing
from brakeline.messaging.ray_directions import LidarRays
from brakeline.messaging.ros2 import cdr_messages as cdr
from brakeline.sim.arena_generator import draw_arena
from brakeline.sim.ground_realtime import RealtimeGroundRobot
from brakeline.sim.ground_robot import SAMPLE_TIME, SAMPLES
from brakeline.sim.lidar import Lidar
from tests.actors.ros2.test_ros_inputs import odometry, scan_of
from tests.robots import GROUND

ROBOT = GROUND.in_real_time()
LEAD = 0.04  # s
NEAREST, FARTHEST, NOISE = 0.05, 3.5, 0.01  # m
MOUNT = PlanarPose(-0.032, 0.0, 0.0)
PERSISTENCE = 40  # periods for which a rammer aims at one thing, or drives away from it


@dataclass
class Drive:
    """One robot in one arena, and what happened to it."""

    kinds: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    robot: RealtimeGroundRobot | None = None
    longest_wait: int = 0  # periods in a row without a decision, after the first decision
    turned: float = 0.0  # rad


class SectorLidar:
    """A lidar with beams over a sector, one after the other; directions in `masked` (rad, in its frame) say nothing."""

    def __init__(self, arena, rng, degrees, masked=(), step=1.0):
        self.angles = np.radians(np.arange(-0.5 * degrees, 0.5 * degrees, step))
        self.step, self._masked = (
            math.radians(step),
            [np.abs(np.angle(np.exp(1j * (self.angles - at)))) < half for at, half in masked],
        )
        ways = np.stack([np.cos(self.angles), np.sin(self.angles)], axis=1)
        self._sectors = [Lidar(arena, LidarRays(part, FARTHEST), NOISE, rng) for part in np.array_split(ways, SAMPLES)]
        self._measured = []

    def measure(self, true):
        """Return the ranges of a turn when it is complete, else None."""
        heading = float(true[2])
        origin = true[:2] + MOUNT.x * np.array([math.cos(heading), math.sin(heading)])
        self._measured.append(self._sectors[len(self._measured)].ranges(origin, heading))
        if len(self._measured) < SAMPLES:
            return None
        ranges, self._measured = np.concatenate(self._measured), []
        ranges = np.where(ranges >= FARTHEST, np.inf, np.where(ranges < NEAREST, -np.inf, ranges))
        for masked in self._masked:
            ranges[masked] = math.nan
        return ranges


def ram(seed):
    """Return a policy that aims at what a scan shows, then drives away; it never stops for an obstacle."""
    rng, count, aim = np.random.default_rng(seed), 0, 0.0

    def policy(angles, ranges):
        nonlocal count, aim
        ranges = np.where(np.isfinite(ranges), ranges, 9.0)
        if count % PERSISTENCE == 0:
            aim = rng.uniform(-2.0, 2.0)
        count += 1
        off = np.abs(np.angle(np.exp(1j * (angles - aim))))
        if count // PERSISTENCE % 2:
            room = np.array([np.roll(ranges, k) for k in range(-15, 16)]).min(axis=0)
            target = angles[np.argmax(np.where(off < 1.5, room, 0.0))]
        else:
            target = angles[np.argmin(np.where(off < 0.6, ranges, 99.0))]
        turn = float(np.clip(2.0 * target, -0.5, 0.5))
        aim = target - 0.2 * turn
        return 0.25 if abs(target) < 0.5 else 0.0, turn

    return policy


def drive(ask: Ask, seed, periods, degrees, policy, arena="default", masked=(), step=1.0, **sensors) -> Drive:
    """Drive for some periods in an arena; sensors: further fields of `SensorSettings`."""
    rng = np.random.default_rng((seed, 11))
    room = draw_arena(arena, np.random.default_rng(seed), GROUND)
    outcome = Drive(robot=RealtimeGroundRobot(room, rng))
    lidar = SectorLidar(room, rng, degrees, masked, step)
    inputs = RosInputs(ROBOT, SensorSettings(mount=MOUNT, **sensors), AgeLimits())
    gate, robot, waits = CommandGate(ROBOT, ask), outcome.robot, 0
    why, seen = "not begun", None
    for number in range(periods):
        began = 10.0 + number * ROBOT.period
        robot.set_input(gate.begin(began, True, why))
        outcome.kinds[gate.kind] += 1
        outcome.reasons[gate.reason.partition(":")[2][:60] if gate.kind == "blind" else gate.reason[:60]] += 1
        waits = waits + 1 if gate.kind == "blind" and number > 2 else 0
        outcome.longest_wait = max(outcome.longest_wait, waits)
        if number == 0:
            inputs.on_odometry(_odometry(began, robot.measured))
        for sample in range(SAMPLES):
            if sample == SAMPLES - round(LEAD / SAMPLE_TIME):
                why = _decide(inputs, gate, began, began + ROBOT.period - LEAD, number)
            before = robot.true[2]
            robot.advance()
            outcome.turned += abs(math.remainder(robot.true[2] - before, math.tau))
            at = began + (sample + 1) * SAMPLE_TIME
            inputs.on_odometry(_odometry(at, robot.measured))
            ranges = lidar.measure(robot.true)
            if ranges is not None:
                seen = ranges
                inputs.on_scan(_scan(lidar, ranges, at))
        speed, turn = policy(lidar.angles, np.nan_to_num(seen, nan=9.0, posinf=9.0, neginf=0.0))
        inputs.on_command(cdr.twist(float(speed), float(turn)), began + ROBOT.period)
    return outcome


def _decide(inputs, gate, began, now, number):
    """Decide as `FilterNode._decide` does; return why there is no decision."""
    try:
        state = inputs.state(began, now)
        gate.decide(state, inputs.obstacles(state[:2], now), inputs.command(now), began, number)
    except InputMissing as error:
        return str(error)
    return ""


def _odometry(at, measured):
    x, y, heading, speed, turn_rate = map(float, measured)
    return odometry(at, x, speed, heading, y=y, turn_rate=turn_rate)


def _scan(lidar, ranges, at):
    turn = SAMPLES * SAMPLE_TIME
    return scan_of(
        ranges,
        header=cdr.header(at - turn + 0.5 * SAMPLE_TIME, "base_scan"),
        angle_min=float(lidar.angles[0]),
        angle_increment=lidar.step,
        time_increment=turn / len(ranges),
        range_min=NEAREST,
        range_max=FARTHEST,
    )
