"""A robot of tests only, described in `porter.toml`: its simulator, and a log of somebody driving it about."""

import csv
from pathlib import Path

import numpy as np

from brakeline.messaging.robot import Robot, robot_named

FILE = Path(__file__).with_suffix(".toml")
STEP = 0.02  # s: what a log has a row for
LAG = 0.06  # s
NOISE = np.array([0.004, 0.004, 0.004, 0.008, 0.012])  # half-widths of a measurement, below what the file says
COLUMNS = ("x", "y", "heading", "v", "w", "speed", "turn rate")


def porter() -> Robot:
    return robot_named(str(FILE))


class Porter:
    """Its speeds follow the inputs with a lag; nothing of the product is in it."""

    def __init__(self, rng, pose=(0.0, 0.0, 0.0)):
        self.rng = rng
        self.true = np.array([*pose, 0.0, 0.0])

    def measured(self):
        return self.true + self.rng.uniform(-NOISE, NOISE)

    def step(self, u, seconds=STEP):
        """Positions on the way (k, 2), the last one where it ends."""
        way = []
        x, y, heading, v, w = self.true
        keep = np.exp(-0.01 / LAG)
        for _ in range(round(seconds / 0.01)):
            v, w = u[0] + keep * (v - u[0]), u[1] + keep * (w - u[1])
            heading += 0.01 * w
            x, y = x + 0.01 * v * np.cos(heading), y + 0.01 * v * np.sin(heading)
            way.append((x, y))
        self.true = np.array([x, y, heading, v, w])
        return np.array(way)


def joystick(rng, seconds, stops=True):
    """Inputs (T, 2) each STEP: a hand that moves smoothly, now and then hastily, and sometimes lets go. It never makes
    the ramp that plans have."""
    count, at = round(seconds / STEP), np.zeros(2)
    inputs, target, speed, left, rest = [], np.zeros(2), 4.0, 0, 0
    low, high = np.array([0.0, -1.5]), np.array([0.6, 1.5])
    for k in range(count):
        if left == 0:
            target = np.clip(rng.uniform(low - 0.25 * (high - low), high + 0.25 * (high - low)), low, high)
            speed, left = rng.choice([2.0, 6.0, 25.0]), rng.integers(10, 60)
            rest = rng.integers(60, 120) if stops and rng.random() < 0.3 else 0
        if rest:
            at, rest, left = np.zeros(2), rest - 1, 1 if rest > 1 else 0
        else:
            at = at + (target - at) * min(speed * STEP, 1.0)
            left -= 1
        if not stops:
            at[0] = max(at[0], 0.05)
        if k % 5 == 0:  # a joystick speaks at 10 Hz
            measured = at.copy()
        inputs.append(measured)
    return np.array(inputs)


def drive(seconds=1500.0, seed=0, stops=True):
    """What `driven_by` returns, of a hand on a joystick."""
    rng = np.random.default_rng(seed)
    return driven_by(Porter(rng), joystick(rng, seconds, stops))


def driven_by(robot, inputs):
    """(time (T,), values (T, 7)): measured states and inputs in force from then on, as `COLUMNS` names them."""
    rows = []
    for u in inputs:
        rows.append([*robot.measured(), *u])
        robot.step(u)
    values = np.array(rows)
    values[:, 2] = (values[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return STEP * np.arange(len(rows)), values


def write_csv(path, time, values, columns=COLUMNS):
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("time", *columns))
        rows.writerows([f"{t:.2f}", *map(repr, map(float, row))] for t, row in zip(time, values, strict=True))
    return path
