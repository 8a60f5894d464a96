"""The robots of `drive.py` as vehicles of a task: they judge a policy that was trained on a model of their log."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

from brakeline import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, SimulatedVehicle

sys.path.append(str(Path(__file__).parent))  # a task's code is loaded from its file, which finds nothing beside it
from drive import SAMPLE, VEHICLES, Array, Simulator


class IndependentVehicle(SimulatedVehicle):
    """One robot of `drive.py`, at rest at the start of an arena."""

    def __init__(self, arena: Arena, rng: np.random.Generator, robot: Robot) -> None:
        self.robot, self.arena, self.samples = robot, arena, round(robot.period / SAMPLE)
        self._simulator = Simulator(VEHICLES[robot.kind], rng, np.array([arena.start]))
        self.input = robot.zero_input()
        self.true, self.measured = self._simulator.state[:, 0], self._simulator.measure()[0]

    def step(self, input: Array) -> Period:
        """Drive for one period; see `Vehicle.step`."""
        self.input = self.robot.clip_input(input, self.input)
        start, heading = self.measured[:2], self.measured[2]
        poses = self._simulator.advance(self.input[None], self.robot.period)[:, :, 0]
        self.true, self.measured = self._simulator.state[:, 0], self._simulator.measure()[0]
        sampled = poses[round(len(poses) / self.samples) - 1 :: round(len(poses) / self.samples)]
        path = (sampled[:, :2] - start) @ _rotation(heading)
        path[-1] = (self.measured[:2] - start) @ _rotation(heading)
        hit = bool(self.clearance(poses).min() <= 0.0)
        return self._report(hit, poses, path, float(self.measured[2] - heading))


def _rotation(heading: float) -> Array:
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, -sin], [sin, cos]])


def simulated(conditions: Conditions, tap: object = None, *, robot: Robot) -> MakeVehicle:
    """Return the function that puts a robot at the start of an arena."""
    conditions.check()
    return partial(IndependentVehicle, robot=robot)
