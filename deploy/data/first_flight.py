"""The first flight of a vehicle that nobody has data of: slow first, in a box, each speed after a model of the last.

No filter can help here: what keeps it in the box is a plain rule that takes the vehicle for worse than any. A level of
speed is flown only when data of the levels before gave a model that predicts held-out flight.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.deploy.data.certification import Unsupported, certify_supported
from brakeline.deploy.data.coverage import recording_advice
from brakeline.deploy.data.excitation import limit_slew, random_target
from brakeline.messaging.robot import Robot
from brakeline.safety.model.dataset import BadData, Dataset, Trajectory
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.validation import ValidationReport
from brakeline.safety.model.windows import FREE, windows

Array = NDArray[np.float64]

log = logging.getLogger("brakeline.collect")

LEVELS = (0.2, 0.5, 0.75, 1.0)  # shares of the largest inputs
SHARES = (0.12, 0.13, 0.2, 0.55)  # of the time, a level
TRIES = 2  # times that a level is flown on when no model predicts it
AHEAD = 5  # periods
# m, and s times the level's speed: what 95 % of predictions that far ahead may be off by, to go faster, besides what
# the vehicle's own estimate wanders by
OFF = (0.2, 0.1)
WANDERS = 0.4  # m, of its own estimate in `AHEAD` periods, from which that is what makes the sets wide
PIECE = 60  # periods of a trajectory: whole ones are held out
REACTION, BRAKING = 1.0, 1.5  # s and m/s²: a worse vehicle than any
HOMEWARD = 0.5  # of a level, towards the middle, when the box ends
NEAR = 0.3  # of the way to the wall from which the next stretch leads back
OUTSIDE = 10.0  # m beyond the box at which the flight is over
ORIGIN = "maiden flight"


class FlightEnded(RuntimeError):
    """The flight can't go on, and why; what was flown until then counts."""


@dataclass(frozen=True)
class Box:
    """Where it stays: middle and half-widths (3,), m."""

    middle: Array
    half: Array

    def kept(self, state: Array, wanted: Array, level: Array) -> Array:
        """The wanted input (3,), on an axis on which it could leave the box turned towards the middle."""
        position, velocity = state[:3] - self.middle, state[3:6]
        kept = wanted.copy()
        for axis in range(3):
            for side in (-1.0, 1.0):
                speed = max(side * velocity[axis], side * wanted[axis], 0.0)
                reach = side * position[axis] + REACTION * speed + speed**2 / (2.0 * BRAKING)
                if reach > self.half[axis] and side * wanted[axis] > -HOMEWARD * level[axis]:
                    kept[axis] = -side * HOMEWARD * level[axis]
        return kept

    def outside(self, state: Array) -> float:
        """m beyond its walls."""
        return float(np.max(np.abs(state[:3] - self.middle) - self.half))


def stretch(robot: Robot, share: float, before: Array, rng: np.random.Generator) -> list[Array]:
    """Targets, each held for a while or left at once, then a plan as the filter makes them: inputs (3,), slewed."""
    inputs = [before]
    for _ in range(rng.integers(4)):
        target = share * random_target(robot, rng)
        for _ in range(rng.integers(1, 4 if rng.random() < 0.6 else 12)):
            inputs.append(limit_slew(robot, inputs[-1], target))
    chosen = limit_slew(robot, inputs[-1], share * random_target(robot, rng))
    waiting = replace(robot.in_lockstep(), free_steps=1)
    inputs += list((waiting.plan_matrix() @ chosen).reshape(waiting.horizon, -1))
    standing = rng.integers(3) if rng.random() < 0.9 else 12
    return inputs[1:] + [np.zeros(robot.action_dim)] * int(standing)


def homeward(inputs: list[Array], state: Array, box: Box, period: float, rng: np.random.Generator) -> list[Array]:
    """The stretch mirrored on those axes on which it would lead from near a wall to it; others by chance. Only where
    it begins at rest: mirrored, it would not follow on."""
    away = np.asarray(inputs).sum(0) * period
    offset = (state[:3] - box.middle) / box.half
    signs = np.where(np.abs(offset) > NEAR, -np.sign(offset * away), rng.choice([-1.0, 1.0], 3))
    return [np.where(signs == 0.0, 1.0, signs) * u for u in inputs]


@dataclass
class FlightRecording:
    """What was recorded, in pieces."""

    trajectories: list[Trajectory] = field(default_factory=list)
    states: list[Array] = field(default_factory=list)
    inputs: list[Array] = field(default_factory=list)
    paths: list[Array] = field(default_factory=list)
    before: Array | None = None

    def cut(self) -> None:
        """End the piece: nothing pairs its last sample with what follows."""
        if len(self.inputs) > 2:
            arrays = np.array(self.states), np.array(self.inputs), np.array(self.paths)
            self.trajectories.append(Trajectory(*arrays, np.zeros(len(self.inputs)), self.before))
        self.states, self.inputs, self.paths = [], [], []

    def dataset(self, robot: Robot, about: dict[str, str]) -> Dataset:
        data = Dataset(robot, tuple(self.trajectories), about | {"origin": ORIGIN})
        data.check()
        return data


@dataclass(frozen=True)
class FirstFlightResult:
    """What a flight ended with."""

    data: Dataset
    model: ModelSet | None
    statement: ValidationReport | None
    level: float  # share of the largest inputs that was flown and predicted
    missing: tuple[str, ...]
    seconds: float


class FirstFlight:
    """Flies one vehicle that hovers where the box's middle is to be."""

    def __init__(
        self, vehicle: MavlinkVehicle, robot: Robot, box: Box, seed: int, stop: Callable[[], bool] = lambda: False
    ) -> None:
        """robot: in real time."""
        self._vehicle, self._robot, self._box, self._stop = vehicle, robot, box, stop
        self._rng, self._flown = np.random.default_rng(seed), FlightRecording()
        self._periods = 0

    def fly(self, minutes: float, about: dict[str, str]) -> FirstFlightResult:
        """Level after level; the last until the time is up."""
        missing, reached = list[str](), 0.0
        try:
            for level, share in zip(LEVELS, SHARES, strict=True):
                for _ in range(TRIES):
                    self._record(level, 60.0 * minutes * share)
                    speed, off = level * float(self._robot.high().max()), self._off()
                    wander = _wander(self._flown.trajectories, self._robot.period)
                    log.info("a model is off by %.2f m a second ahead, its own estimate by %.2f m", off, wander)
                    if off < wander + OFF[0] + OFF[1] * speed:
                        break
                else:
                    missing.append(f"no model predicts it at {level:.0%} of its speed: it was not flown faster")
                    break
                reached = level
        except FlightEnded as error:
            missing.append(str(error))
        self._flown.cut()
        data = self._flown.dataset(self._robot.in_lockstep(), about)
        model, statement = self._model(data, missing)
        wander = _wander(data.trajectories, self._robot.period)
        if wander > WANDERS:
            missing.append(
                f"its own estimate is {wander:.2f} m off its own velocity after a second (95 %), and no set can be "
                "narrower: tell its estimator how noisy and how late its sensors are, and fly again"
            )
        if reached < 1.0:
            missing.append(f"nothing is known beyond {reached:.0%} of its speed")
        missing += [] if statement is None else recording_advice(statement, data)
        return FirstFlightResult(data, model, statement, reached, tuple(missing), self._periods * self._robot.period)

    def _record(self, level: float, seconds: float) -> None:
        """Raises FlightEnded."""
        vehicle, robot = self._vehicle, self._robot
        bounds = level * robot.high()
        log.info("%.0f %% of its speed: %.1f m/s an axis, for %.0f s", 100 * level, bounds.max(), seconds)
        vehicle.wait(vehicle.current_period.number + 1)
        self._flown.cut()
        end = self._periods + round(seconds / robot.period)
        while self._periods < end:
            for wanted in self._next(level):
                if self._period(wanted, bounds):
                    break
        self._flown.cut()
        vehicle.wait(vehicle.current_period.number + 5)

    def _next(self, level: float) -> list[Array]:
        period = self._vehicle.current_period
        inputs = stretch(self._robot, level, period.input, self._rng)
        if not period.input.any():
            return homeward(inputs, period.report.measured, self._box, self._robot.period, self._rng)
        return inputs

    def _period(self, wanted: Array, level: Array) -> bool:
        """Fly one; whether the box had its way, or the recording a gap: the stretch is over. Raises FlightEnded."""
        vehicle, flown, box = self._vehicle, self._flown, self._box
        before = vehicle.current_period
        kept = box.kept(before.report.measured, wanted, level)
        vehicle.commit(kept[None], before.number + 1)
        period = vehicle.wait(before.number + 1)
        self._periods += 1
        if period.number != before.number + 1 or period.lost:
            flown.cut()
            if period.lost:
                self._patiently()
            return True
        if not flown.states:
            flown.states, flown.before = [period.report.measured], before.input
        else:
            flown.states.append(period.report.measured)
            flown.paths.append(period.report.subsamples)
            flown.inputs.append(before.input)
        if len(flown.inputs) >= PIECE:
            flown.cut()
        if box.outside(period.report.measured) > OUTSIDE:
            raise FlightEnded(
                f"it left its box by {box.outside(period.report.measured):.0f} m: it does not do what it is asked to"
            )
        if self._stop():
            raise FlightEnded("told to stop")
        return bool((kept != wanted).any())

    def _patiently(self) -> None:
        """Lost telemetry, or a pilot who took over: hover until it is over, and give up after a while."""
        for _ in range(round(10.0 / self._robot.period)):
            if not self._vehicle.wait(self._vehicle.current_period.number + 1).lost:
                return
        raise FlightEnded(f"it was lost for 10 s: {self._vehicle.current_period.lost}")

    def _off(self) -> float:
        """m, 95 % of held-out predictions `AHEAD` periods ahead are better: a linear fit of what was flown so far."""
        try:
            parts = [
                windows(part, AHEAD, FREE)
                for part in self._flown.dataset(self._robot.in_lockstep(), {}).split((0.5, 0.5))
            ]
        except BadData:
            return math.inf
        fitted, held_out = parts
        if min(len(fitted), len(held_out)) < fitted.z.shape[1]:
            return math.inf
        C = np.linalg.lstsq(fitted.z, fitted.y[:, :3], rcond=None)[0]
        return float(np.quantile(np.linalg.norm(held_out.y[:, :3] - held_out.z @ C, axis=1), 0.95))

    def _model(self, data: Dataset, missing: list[str]) -> tuple[ModelSet, ValidationReport] | tuple[None, None]:
        """While the vehicle hovers."""
        try:
            model, statement, _ = certify_supported(replace(data, robot=self._robot), ModelConfig().of_minutes())
        except (BadData, Unsupported) as error:
            missing.append(f"there is no model set: {error}")
            return None, None
        return model, statement


def _wander(trajectories: Sequence[Trajectory], period: float) -> float:
    """m, what 95 % of the ways of `AHEAD` periods are off the way by its own velocity: no model can be better."""
    off = [np.zeros((1, 3))]
    for t in trajectories:
        position, velocity = t.states[:, :3], t.states[:, 3:6]
        by_velocity = np.cumsum(0.5 * period * (velocity[1:] + velocity[:-1]), axis=0)
        error = position[1:] - by_velocity
        off.append(error[AHEAD:] - error[:-AHEAD])
    return float(np.quantile(np.linalg.norm(np.concatenate(off), axis=1), 0.95))
