"""Simulate a robot by a model set made from its own log (docs/your_robot.md).

For some robots there is a log, but no simulator. The model set of mode one-step predicts one control period
(docs/method.md §13). This simulator repeats the prediction with random errors, so it moves about as the robot does. The
filter uses the same sets here and on the robot, so a policy learns how much room these sets need.

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
from brakeline.sim.ground_estimator import wrap
from brakeline.sim.sim_conditions import Conditions
from brakeline.sim.vehicle import MakeVehicle, Period, SimulatedVehicle

SAMPLES = 5  # of the position in a period
# Standard deviation of an error in the trials, and at most, as a share of the half-width of the set after one period.
# In the first flights of an ArduCopter and a PX4, the shares were 0.11 to 0.25, by coordinate. A policy that learned
# with 0.25 flew worse than one with 0.15 (docs/autopilot_flights.md).
TRIED_ERROR, LARGEST_ERROR = 0.05, 0.15
CUT = 0.95  # largest single error, as a share of the same half-width
TRIALS = 500  # simulated stops, which decide how large the errors are


class LearnedMotion:
    """The motion of many robots that a model set predicts, with random errors in each period.

    Attributes:
        model: the model set, of mode one-step. robot: its robot.
        error_share: standard deviation of an error, as a share of the half-width of the set after one period. It is
            the largest one, up to LARGEST_ERROR, with which 99 % of `TRIALS` stops from random inputs stay in all
            their sets. With larger errors, the simulated robot would leave sets that the real one stays in.
    """

    def __init__(self, model: ModelSet) -> None:
        assert model.one_step is not None
        self.model, self.robot, self._predictor = model, model.robot, model.one_step
        self._measured = list(self.robot.regressor)
        self._least, self._most = model.domain[:, : len(self._measured)]  # recorded
        self.error_share = min(TRIED_ERROR / self._share_used(), LARGEST_ERROR)

    def after_one_period(self, state: Array, before: Array, input: Array, errors: Array) -> tuple[Array, Array]:
        """Return the states (T, n) after a period, and the changes (T, n): of the pose in the frame of its start.

        Args:
            state: (T, n). before, input (T, m): the inputs of the period before and of this one.
            errors (T, n): as shares of the half-widths of the set after one period.
        """
        robot, n, d = self.robot, self.robot.state_dim, self.robot.position_dim
        window = np.hstack([state[:, self._measured], before, np.tile(input, (1, robot.horizon))])
        most = self.model.steps[0].half_widths(window)[:, :n] * self._predictor.stretches(robot, window)[:, :1]
        change = self._predictor.rollouts(robot, window)[:, 0, :n] + errors * most
        # Beyond what was recorded, a predictor can diverge.
        change[:, self._measured] = np.clip(change[:, self._measured], self._least, self._most)
        after, turn = change.copy(), self.turns(state)
        after[:, :d] = state[:, :d] + np.einsum("tij,tj->ti", turn, change[:, :d])
        if robot.heading is not None:
            after[:, robot.heading] = wrap(state[:, robot.heading] + change[:, robot.heading])
        return after, change

    def turns(self, states: Array) -> Array:
        """Return the rotations (T, d, d) from the robot's frame to the world in states (T, n)."""
        if self.robot.heading is None:
            return np.broadcast_to(np.eye(self.robot.position_dim), (len(states), *(self.robot.position_dim,) * 2))
        cos, sin = np.cos(states[:, self.robot.heading]), np.sin(states[:, self.robot.heading])
        return np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)

    def errors(self, rng: np.random.Generator, share: float, count: int = 1) -> Array:
        """Return random errors (count, n) for `after_one_period`."""
        return np.clip(share * rng.standard_normal((count, self.robot.state_dim)), -CUT, CUT)

    def _share_used(self) -> float:
        """Return the share of a plan's sets of positions that errors of TRIED_ERROR use: 99 % of stops use less."""
        robot, d, rng = self.robot, self.robot.position_dim, np.random.default_rng(0)
        inputs = rng.uniform(robot.low(), robot.high(), (TRIALS, robot.action_dim))
        start = np.array([robot.state_at_inputs(u) for u in inputs])
        start[:, self._measured] = np.clip(start[:, self._measured], self._least, self._most)
        stops = inputs[:, None] * robot.stop_profile()[None, : robot.horizon]
        window = np.hstack([start[:, self._measured], inputs, stops.reshape(TRIALS, -1)])
        expected, stretches = self._predictor.rollouts_with_stretch(robot, window)
        state, before, used = start, inputs, np.zeros(TRIALS)
        for i, step in enumerate(self.model.steps):
            errors = self.errors(rng, TRIED_ERROR, TRIALS)
            state, _ = self.after_one_period(state, before, stops[:, i], errors)
            before = stops[:, i]
            most = step.half_widths(window)[:, :d] * stretches[:, i : i + 1]
            off = np.einsum("tji,tj->ti", self.turns(start), state[:, :d] - start[:, :d]) - expected[:, i, :d]
            used = np.maximum(used, (np.abs(off) / most).max(axis=1))
        return float(np.quantile(used, 0.99))


class LearnedVehicle(SimulatedVehicle):
    """A robot that moves as a model set predicts, with random errors; it measures its state exactly.

    It moves along a straight line from the start of a period to its end. Its speeds stay within the recorded ones.
    """

    samples = SAMPLES

    def __init__(self, arena: Arena, rng: np.random.Generator, motion: LearnedMotion) -> None:
        """Put the robot at the start of an arena, at rest.

        Raises:
            ValueError: the arena has moving obstacles.
        """
        if arena.crowd is not None:
            raise ValueError(f"a robot that is simulated by its model set meets no moving obstacles: {arena.name}")
        self.arena, self.robot, self._rng, self._motion = arena, motion.robot, rng, motion
        self.acceleration_age = motion.model.acceleration_age
        robot, d = self.robot, self.robot.position_dim
        self.true = np.zeros(robot.state_dim)
        self.true[:d] = arena.start[:d]
        if robot.heading is not None:
            self.true[robot.heading] = arena.start[d]
        self.measured, self.input = self.true, robot.zero_input()

    def step(self, input: Array) -> Period:
        """Move for one period; see `Vehicle.step`."""
        motion, heading, d = self._motion, self.robot.heading, self.robot.position_dim
        start, before, self.input = self.true, self.input, self.robot.clip_input(input, self.input)
        errors = motion.errors(self._rng, motion.error_share)
        after, change = motion.after_one_period(start[None], before[None], self.input[None], errors)
        self.true = self.measured = after[0]
        shares = np.linspace(0.0, 1.0, SAMPLES + 1)[1:, None]
        states, turned = np.tile(start, (SAMPLES, 1)), 0.0
        states[:, :d] += shares * (after[0, :d] - start[:d])
        if heading is not None:
            turned = float(change[0, heading])
            states[:, heading] += shares[:, 0] * turned
        return self._report(bool(self.clearance(states).min() <= 0.0), states, shares * change[:, :d], turned)


def simulated(conditions: Conditions, tap: object = None, *, robot: Robot) -> MakeVehicle:
    """Return a function that makes vehicles by the robot's model set of mode one-step, the one in use.

    Raises:
        BadModel: there is none.
        Mismatch: it is about another robot.
        ValueError: a condition is not simulated here.
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
    return partial(LearnedVehicle, motion=LearnedMotion(model))
