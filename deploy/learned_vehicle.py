"""Simulate a robot by a model set made from its own log (docs/environments.md).

A robot may exist only in a log: nobody wrote a simulator of it. Its model set of mode one-step predicts one control
period (docs/method.md §13). Rolled out with random errors, this is a simulator that moves about as the robot does,
behind exactly the sets that the filter will use on the robot. A policy that learns in it learns how much room these
sets need.

It proves nothing about the robot: it is wrong wherever the predictor is. Judge a policy on the robot.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from brakeline.deploy.data.data_paths import model_path
from brakeline.errors import BadModel, Mismatch
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.model_config import ONE_STEP, ModelConfig
from brakeline.safety.model.model_set import ModelSet
from brakeline.sim.arena import Arena
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, SimulatedVehicle

SAMPLES = 5  # of the position in a period
# Standard deviation of an error, as a share of the half-width of the set after one period. In two first flights, of an
# ArduCopter and a PX4, it was 0.11 to 0.25, by coordinate.
ERROR_SHARE = 0.15
MOST_ERROR = 0.95  # of a half-width


class LearnedVehicle(SimulatedVehicle):
    """A robot that moves as a model set predicts, with random errors; it measures its state exactly.

    It moves along a straight line from the start of a period to its end. Its speeds stay within the recorded ones.
    """

    samples = SAMPLES

    def __init__(self, arena: Arena, rng: np.random.Generator, model: ModelSet) -> None:
        """Put the robot at the start of an arena, at rest.

        Raises:
            ValueError: the arena has moving obstacles.
        """
        if arena.crowd is not None:
            raise ValueError(f"a robot that is simulated by its model set meets no moving obstacles: {arena.name}")
        assert model.one_step is not None
        self.arena, self.robot, self._rng, self._predictor = arena, model.robot, rng, model.one_step
        self._half_widths, self.acceleration_age = model.steps[0].half_widths, model.acceleration_age
        self._least, self._most = model.domain[:, : len(model.robot.regressor)]  # recorded
        robot, d = self.robot, self.robot.position_dim
        self.true = np.zeros(robot.state_dim)
        self.true[:d] = arena.start[:d]
        if robot.heading is not None:
            self.true[robot.heading] = arena.start[d]
        self._centers, self._radii = (
            np.array([getattr(disc, name) for disc in robot.body]) for name in ("at", "radius")
        )
        self.measured, self.input = self.true, robot.zero_input()

    def step(self, input: Array) -> Period:
        """Move for one period; see `Vehicle.step`."""
        robot, d = self.robot, self.robot.position_dim
        start, before, self.input = self.true, self.input, robot.clip_input(input, self.input)
        change = self._after_one_period(before)
        moved, turn, turned = change[:d].copy(), self._turn(start), 0.0
        change[:d] = start[:d] + turn @ moved
        if robot.heading is not None:
            turned = float(change[robot.heading])
            change[robot.heading] = (start[robot.heading] + turned + np.pi) % (2.0 * np.pi) - np.pi
        self.true = self.measured = change
        shares = np.linspace(0.0, 1.0, SAMPLES + 1)[1:, None]
        states = np.tile(start, (SAMPLES, 1))
        states[:, :d] += shares * (turn @ moved)
        if robot.heading is not None:
            states[:, robot.heading] += shares[:, 0] * turned
        return self._report(bool(self.clearance(states).min() <= 0.0), states, shares * moved, turned)

    def _after_one_period(self, before: Array) -> Array:
        """Return the outputs of the predictor (n,) with errors: position and heading as changes, in the robot's frame.

        before (m,): the input of the period before.
        """
        robot, n = self.robot, self.robot.state_dim
        window = np.concatenate([self.true[list(robot.regressor)], before, np.tile(self.input, robot.horizon)])[None]
        most = self._half_widths(window)[0, :n] * self._predictor.stretches(robot, window)[0, 0]
        error = np.clip(ERROR_SHARE * self._rng.standard_normal(n), -MOST_ERROR, MOST_ERROR)
        after = self._predictor.rollouts(robot, window)[0, 0, :n] + error * most
        measured = list(robot.regressor)  # beyond what was recorded, a predictor can diverge
        after[measured] = np.clip(after[measured], self._least, self._most)
        return np.asarray(after)

    def _turn(self, state: Array) -> Array:
        """Return the rotation (d, d) from the robot's frame to the world."""
        if self.robot.heading is None:
            return np.eye(self.robot.position_dim)
        cos, sin = np.cos(state[self.robot.heading]), np.sin(state[self.robot.heading])
        return np.array([[cos, -sin], [sin, cos]])

    def clearance(self, states: Array) -> Array:
        """Return the distance [m] from the nearest disc of the body in states (S, n) to the nearest obstacle."""
        d = self.robot.position_dim
        centers = np.stack([state[:d] + self._centers @ self._turn(state).T for state in np.atleast_2d(states)])
        return np.asarray((self.arena.shapes.distance(centers).min(axis=0) - self._radii).min(axis=-1))


def simulated(conditions: Conditions, tap: object = None, *, robot: Robot) -> MakeVehicle:
    """Return a function that makes vehicles by the robot's model set of mode one-step, the one in use.

    Raises:
        BadModel: there is none.
        Mismatch: it is about another robot.
        ValueError: the conditions have something that such a vehicle has not.
    """
    conditions.check("learned")
    path = model_path(robot, ModelConfig(mode=ONE_STEP))
    if not path.exists():
        raise BadModel(
            f"{robot.name} has no model set of mode one-step in {path}: make one of its log with `brakeline certify "
            f"{robot.name} --data LOG --use`, or simulate the robot without --learned"
        )
    model = ModelSet.load(path)
    if model.robot.layout() != robot.layout():
        raise Mismatch(f"{path}: the model set is about another {robot.name}: certify this one")
    return partial(LearnedVehicle, model=model)
