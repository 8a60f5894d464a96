"""Simulate four robots that somebody drives by joystick, and print the log as CSV. It needs NumPy alone.

python examples/own_log/drive.py skid --minutes 15 --seed 1 > skid.csv

The simulators import nothing from Brakeline, so they can judge it: `table.py` takes collisions from their true paths.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SUBSTEP = 0.01  # s of the integration
SAMPLE = 0.05  # s between two rows of a log
POSITION, HEADING, SPEED, RATE = 0.003, 0.005, 0.01, 0.02  # largest sensor errors [m, rad, m/s, rad/s]
OTHER_COLUMNS = ("time", "run")


@dataclass(frozen=True)
class Vehicle:
    """A simulated robot in the plane."""

    period: float  # time between two inputs [s]
    state: tuple[str, ...]  # names of the coordinates. The first three are x, y and heading.
    errors: tuple[float, ...]  # largest sensor error of each coordinate
    # inputs, low, high: names and bounds of the inputs
    inputs: tuple[str, str]
    low: tuple[float, float]
    high: tuple[float, float]
    delays: tuple[float, float]  # time from an input to its first effect [s]
    rest: float  # time in which the robot comes to a stand [s]
    body: tuple[tuple[float, float], ...]  # discs (ahead, radius) that hold the body [m]
    # derivatives of the true coordinates, from these coordinates and the delayed inputs, each (count,)
    rates: Callable[[Array, Array, Array], tuple[Array, ...]]


def _moving(heading: Array, ahead: Array, aside: Array | float, turning: Array) -> tuple[Array, Array, Array]:
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * ahead - sin * aside, sin * ahead + cos * aside, turning


def _diff(s: Array, speed: Array, turn: Array) -> tuple[Array, ...]:
    """Two driven wheels; speed and turn rate follow their inputs with lags of 0.15 s and 0.12 s."""
    return *_moving(s[2], s[3], 0.0, s[4]), (speed - s[3]) / 0.15, (turn - s[4]) / 0.12


def _skid(s: Array, speed: Array, turn: Array) -> tuple[Array, ...]:
    """Four wheels that slip: at full speed it turns 30 % slower, and it slides outwards in a turn."""
    slipping = turn * (1.0 - 0.3 * np.abs(s[3]) / 0.8)
    return *_moving(s[2], s[3], -0.05 * s[3] * s[4], s[4]), (speed - s[3]) / 0.25, (slipping - s[4]) / 0.2


def _car(s: Array, speed: Array, steering: Array) -> tuple[Array, ...]:
    """A bicycle model with a wheelbase of 0.3 m that understeers. Its servo follows with a lag of 0.08 s."""
    turning = s[3] * np.tan(s[4]) / (0.3 * (1.0 + 0.1 * s[3] ** 2))
    return *_moving(s[2], s[3], 0.0, turning), (speed - s[3]) / 0.2, (steering - s[4]) / 0.08


def _boat(s: Array, speed: Array, turn: Array) -> tuple[Array, ...]:
    """A boat that drifts outwards in a turn, and loses speed in it."""
    surge, sway, rate = s[3], s[4], s[5]
    ahead, aside = (speed - surge) / 0.5 + 0.3 * sway * rate, -sway / 0.4 - 0.6 * surge * rate
    return *_moving(s[2], surge, sway, rate), ahead, aside, (turn - rate) / 0.35


POSE = ("x", "y", "heading")
POSE_ERRORS = (POSITION, POSITION, HEADING)
ROUND = ((0.0, 0.15),)
VEHICLES = {
    "diff": Vehicle(
        period=0.2,
        state=(*POSE, "v", "w"),
        errors=(*POSE_ERRORS, SPEED, RATE),
        inputs=("speed", "turn rate"),
        low=(0.0, -1.5),
        high=(0.6, 1.5),
        delays=(0.0, 0.0),
        rest=1.2,
        body=ROUND,
        rates=_diff,
    ),
    "skid": Vehicle(
        period=0.1,
        state=(*POSE, "v", "w"),
        errors=(*POSE_ERRORS, SPEED, RATE),
        inputs=("speed", "turn rate"),
        low=(-0.3, -1.5),
        high=(0.8, 1.5),
        delays=(0.1, 0.1),
        rest=2.0,
        body=((0.0, 0.2),),
        rates=_skid,
    ),
    "car": Vehicle(
        period=0.2,
        state=(*POSE, "v", "steering angle"),
        errors=(*POSE_ERRORS, SPEED, 0.01),
        inputs=("speed", "steering"),
        low=(-0.4, -0.45),
        high=(0.8, 0.45),
        delays=(0.0, 0.15),
        rest=1.6,
        body=((0.11, 0.155), (-0.11, 0.155)),
        rates=_car,
    ),
    "boat": Vehicle(
        period=0.2,
        state=(*POSE, "surge", "sway", "w"),
        errors=(*POSE_ERRORS, SPEED, SPEED, RATE),
        inputs=("speed", "turn rate"),
        low=(-0.3, -0.8),
        high=(0.8, 0.8),
        delays=(0.0, 0.0),
        rest=4.0,
        body=((0.15, 0.2), (-0.15, 0.2)),
        rates=_boat,
    ),
}


class Simulator:
    """Robots of one kind, all integrated at once by Euler's method."""

    def __init__(self, vehicle: Vehicle, generator: np.random.Generator, poses: Array) -> None:
        """Place robots at rest at the poses (count, 3)."""
        self.vehicle, self.generator = vehicle, generator
        # (n, count): true coordinates. Each robot stands at its start pose.
        self.state = np.zeros((len(vehicle.state), len(poses)))
        self.state[:3] = poses.T
        steps = [round(delay / SUBSTEP) for delay in vehicle.delays]
        self._lines = [deque([np.zeros(len(poses))] * (s + 1), maxlen=s + 1) for s in steps]

    def spread(self, count: int) -> Simulator:
        """Return robots that all seem to be in the true state of the first one: each is off by a sensor's error."""
        other = Simulator(self.vehicle, self.generator, np.zeros((count, 3)))
        other.state = np.repeat(self.state[:, :1], count, axis=1)
        other.state = 2.0 * other.state - other.measure().T
        other._lines = [deque([np.repeat(u[:1], count) for u in line], maxlen=line.maxlen) for line in self._lines]
        return other

    def measure(self) -> Array:
        """Return measured states (count, n), with errors from a normal distribution that is cut at 3 sigma."""
        bound = np.array(self.vehicle.errors)
        noise = np.clip(self.generator.normal(size=self.state.T.shape), -3.0, 3.0)
        return np.asarray(self.state.T + noise * bound / 3.0)

    def advance(self, inputs: Array, seconds: float) -> Array:
        """Apply inputs (count, 2) for some time, and return the true poses (substeps, 3, count)."""
        poses = np.empty((round(seconds / SUBSTEP), 3, self.state.shape[1]))
        for k in range(len(poses)):
            for line, column in zip(self._lines, inputs.T, strict=True):
                line.append(column)
            rates = self.vehicle.rates(self.state, self._lines[0][0], self._lines[1][0])
            self.state = self.state + SUBSTEP * np.array(rates)
            poses[k] = self.state[:3]
        return poses


class Joystick:
    """Somebody who drives: holds the sticks, ramps them, lets go until the robot stands, and is restless at times."""

    def __init__(self, vehicle: Vehicle, generator: np.random.Generator) -> None:
        self.vehicle, self.generator = vehicle, generator
        self.low, self.high = np.array(vehicle.low), np.array(vehicle.high)
        self.sticks, self.target = np.zeros(2), np.zeros(2)
        self.left, self.haste, self.restless = 0, 1.0, False

    def _choose(self) -> None:
        draw, period = self.generator, self.vehicle.period
        kind, self.restless, self.haste = draw.random(), False, float(draw.choice([0.3, 0.6, 1.0]))
        if kind < 0.15:  # let go
            self.target, self.haste = np.zeros(2), 1.0
            self.left = round((self.vehicle.rest + draw.uniform(0.2, 1.0)) / period)
            return
        self.left = max(round(draw.uniform(0.2, 3.0) / period), 1)
        self.target = draw.uniform(self.low, self.high)
        if kind < 0.3:  # one stick to its end, or both
            ends = np.where(draw.random(2) < 0.5, self.low, self.high)
            self.target = np.where(draw.random(2) < 0.6, ends, self.target)
        elif kind < 0.4:
            self.target[int(draw.integers(2))] = 0.0
        elif kind < 0.52:
            self.restless, self.left = True, max(round(draw.uniform(1.0, 4.0) / period), 4)

    def inputs(self) -> Array:
        """Return the inputs (2,) of the next period."""
        if self.left <= 0:
            self._choose()
        self.left -= 1
        if self.restless:
            self.target = self.generator.uniform(self.low, self.high)
            if self.generator.random() < 0.5:
                self.target = np.where(self.generator.random(2) < 0.5, self.low, self.high)
            self.haste = 1.0
        self.sticks = self.sticks + self.haste * (self.target - self.sticks)
        return np.clip(self.sticks, self.low, self.high)


def rows(vehicle: Vehicle, minutes: float, seed: int, runs: int = 1) -> Iterator[list[float]]:
    """Yield the rows [time, run, state, inputs] of a drive that is divided evenly among runs, run by run."""
    generator = np.random.default_rng(seed)
    drivers = [Joystick(vehicle, generator) for _ in range(runs)]
    simulator = Simulator(vehicle, generator, np.zeros((runs, 3)))
    logs: list[list[list[float]]] = [[] for _ in range(runs)]
    samples = round(vehicle.period / SAMPLE)
    for k in range(round(minutes * 60.0 / vehicle.period / runs)):
        inputs = np.array([driver.inputs() for driver in drivers])
        for j in range(samples):
            time = k * vehicle.period + j * SAMPLE
            for run, state in enumerate(simulator.measure()):
                logs[run].append([time, run, *state, *inputs[run]])
            simulator.advance(inputs, SAMPLE)
    for log in logs:
        yield from log


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("robot", choices=VEHICLES)
    parser.add_argument("--minutes", type=float, default=15.0, help="Duration of the drive, all runs together.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of driver and sensor errors.")
    parser.add_argument("--runs", type=int, default=1, help="Number of runs, each from a stand.")
    words = parser.parse_args()
    vehicle = VEHICLES[words.robot]
    out = csv.writer(sys.stdout)
    out.writerow((*OTHER_COLUMNS, *vehicle.state, *vehicle.inputs))
    for row in rows(vehicle, words.minutes, words.seed, words.runs):
        out.writerow([f"{value:.6g}" for value in row])


if __name__ == "__main__":
    main()
