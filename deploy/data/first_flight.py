"""Record the first flight of a vehicle without data: inside a box, at speed levels that rise step by step.

There is no model set yet, so no filter can help. A simple rule keeps the vehicle in the box; it assumes a reaction
time and a deceleration that are worse than those of any real vehicle. A speed level is flown only if a model from the
data of the levels before predicts held-out flight.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from brakeline.actors.mavlink.mavlink_vehicle import MavlinkVehicle
from brakeline.deploy.data.certification import certify_supported
from brakeline.deploy.data.coverage import recording_advice
from brakeline.deploy.data.excitation import limit_slew, random_target
from brakeline.deploy.data.trajectory_builder import TrajectoryBuilder
from brakeline.errors import BadData, FlightEnded, MavlinkError, Unsupported
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.model_set import ONE_STEP, ModelConfig, ModelSet
from brakeline.safety.model.validation import ValidationReport
from brakeline.safety.model.windows import FREE, windows

log = logging.getLogger("brakeline.collect")

LEVELS = (0.2, 0.5, 0.75, 1.0)  # shares of the largest inputs
SHARES = (0.12, 0.13, 0.2, 0.55)  # share of the time for each level
TRIES = 2  # attempts per level until a model predicts it
AHEAD = 5  # periods
# To fly faster, 95 % of the predictions `AHEAD` periods ahead must have an error below OFFSET + TIME * speed of the
# level, in addition to the drift of the vehicle's own estimate.
ERROR_OFFSET, ERROR_TIME = 0.2, 0.1  # m, s
MAX_DRIFT = 0.4  # m in `AHEAD` periods: above it the drift of the vehicle's estimate dominates the width of the sets
PIECE = 60  # periods per trajectory: validation holds out whole trajectories
REACTION, BRAKING = 1.0, 1.5  # s and m/s²: worse than any real vehicle
RETURN_SPEED = 0.5  # share of the level's speed, towards the middle, near a wall
NEAR = 0.3  # share of the distance to the wall from which the next leg leads back
STOPS, LEFT_EARLY = 0.3, 0.5  # shares of the legs that stop, and of the stops that end before the vehicle stands
HASTY, LONGEST = 0.25, 15  # share of the targets that are left within three periods; periods that bound the others
OUTSIDE = 10.0  # m beyond the box at which the flight ends
ORIGIN = "maiden flight"


@dataclass(frozen=True)
class Box:
    """The region of the flight: middle and half-widths (3,) in m."""

    middle: Array
    half: Array

    def constrain(self, state: Array, wanted: Array, level: Array) -> Array:
        """Return the wanted input (3,) in m/s; on each axis that could leave the box, steer to the middle."""
        position, velocity = state[:3] - self.middle, state[3:6]
        allowed = wanted.copy()
        for axis in range(3):
            for side in (-1.0, 1.0):
                speed = max(side * velocity[axis], side * wanted[axis], 0.0)
                reach = side * position[axis] + REACTION * speed + speed**2 / (2.0 * BRAKING)
                if reach > self.half[axis] and side * wanted[axis] > -RETURN_SPEED * level[axis]:
                    allowed[axis] = -side * RETURN_SPEED * level[axis]
        return allowed

    def outside(self, state: Array) -> float:
        """Return how far the vehicle is outside the box, in m; negative inside."""
        return float(np.max(np.abs(state[:3] - self.middle) - self.half))


def draw_leg(
    robot: Robot, box: Box, share: float, state: Array, before: Array, rng: np.random.Generator
) -> list[Array]:
    """Draw a leg of the flight: a target that is held or left at once, or a plan like the filter's: inputs (3,).

    Errors are largest in fast flight, so minutes must hold much of it: only some legs stop, and some stops are left
    early. Targets lead away from a near wall.

    Args:
        robot: the robot in real time.
        box: the region of the flight.
        share: of the largest inputs.
        state (9,): the measured state.
        before (3,): the input in force, in m/s.
        rng: the source of randomness.
    """
    target = _inwards(share * random_target(robot, rng), state, box)
    if not before.any() or rng.random() >= STOPS:
        inputs = [before]
        for _ in range(rng.integers(1, 4 if rng.random() < HASTY else LONGEST)):
            inputs.append(limit_slew(robot, inputs[-1], target))
        return inputs[1:]
    waiting = replace(robot.in_lockstep(), free_steps=1)
    plan = list((waiting.plan_matrix() @ limit_slew(robot, before, target)).reshape(waiting.horizon, -1))
    if rng.random() < LEFT_EARLY:
        return plan[: rng.integers(1, len(plan))]
    standing = rng.integers(3) if rng.random() < 0.9 else 12
    return plan + [np.zeros(robot.action_dim)] * int(standing)


def _inwards(target: Array, state: Array, box: Box) -> Array:
    """Return a target (3,) that leads to the middle on each axis on which the vehicle is near a wall."""
    offset = (state[:3] - box.middle) / box.half
    return np.where(np.abs(offset) > NEAR, -np.sign(offset) * np.abs(target), target)


@dataclass(frozen=True)
class FirstFlightResult:
    """The result of a first flight. `missing` says in sentences what the data lack."""

    data: Dataset
    model: ModelSet | None
    report: ValidationReport | None
    level: float  # share of the largest inputs that was flown and that a model predicts
    missing: tuple[str, ...]
    seconds: float


class FirstFlight:
    """Flies one vehicle, which hovers in the middle of the box at first."""

    def __init__(
        self,
        vehicle: MavlinkVehicle,
        robot: Robot,
        box: Box,
        seed: int,
        about: dict[str, str],
        stop: Callable[[], bool] = lambda: False,
        keep: Callable[[Callable[[], Dataset]], None] = lambda data: None,
    ) -> None:
        """Prepare the flight.

        Args:
            vehicle: hovers in the middle of the box.
            robot: in real time.
            box: the region of the flight.
            seed: of the flight's random inputs.
            about: entries of the data set.
            stop: is polled every period.
            keep: called after each piece of the flight, with a function that returns the data until then.
        """
        self._vehicle, self._robot, self._box, self._stop = vehicle, robot, box, stop
        self._about, self._keep = about | {"origin": ORIGIN}, keep
        self._rng, self._periods = np.random.default_rng(seed), 0
        self._flown: list[Trajectory] = []
        self._built: TrajectoryBuilder | None = None
        self._reached, self._missing = 0.0, list[str]()

    def fly(self, minutes: float) -> None:
        """Fly all levels. An error ends the flight, whatever it is, and what was recorded stays."""
        try:
            for level, share in zip(LEVELS, SHARES, strict=True):
                if not any(self._predicted(level, 60.0 * minutes * share) for _ in range(TRIES)):
                    self._missing.append(
                        f"no model predicts the vehicle at {level:.0%} of its speed, so it was not flown faster"
                    )
                    break
                self._reached = level
        except (MavlinkError, FlightEnded) as error:
            self._missing.append(str(error))
        except Exception as error:  # a mistake of the program: what was recorded must not be lost with it
            log.exception("the flight ends")
            self._missing.append(f"the flight ended with an error: {type(error).__name__}: {error}")
        self._cut()

    def result(self, store: Callable[[Dataset], object]) -> FirstFlightResult:
        """Return the data, and the model set if the data support one.

        store: called with the data before the fit of the model set, which may be interrupted.

        Raises BadData: nothing was recorded.
        """
        missing, reached = list(self._missing), self._reached
        if not self._flown:
            raise BadData(f"nothing was recorded: {'; '.join(missing)}")
        data = self._dataset()
        store(data)
        model, report = self._model(data, missing)
        if (drift := self._drift()) > MAX_DRIFT:
            missing.append(
                f"the position of its own estimate is {drift:.2f} m off its integrated velocity after a second "
                "(95 %), and no set can be narrower: set sensor noise and delay in its estimator, then fly again"
            )
        if reached < 1.0:
            missing.append(f"there are no data above {reached:.0%} of its speed")
        missing += [] if report is None else recording_advice(report, data)
        return FirstFlightResult(data, model, report, reached, tuple(missing), self._periods * self._robot.period)

    def _predicted(self, level: float, seconds: float) -> bool:
        """Record at one level, and return whether a model predicts the flight so far. Raises FlightEnded."""
        self._record(level, seconds)
        error, drift = self._prediction_error(), self._drift()
        log.info("prediction error one second ahead: %.2f m; drift of the estimate: %.2f m", error, drift)
        return error < drift + ERROR_OFFSET + ERROR_TIME * level * float(self._robot.high().max())

    def _record(self, level: float, seconds: float) -> None:
        """Record at one level. Raises FlightEnded."""
        vehicle, robot = self._vehicle, self._robot
        bounds = level * robot.high()
        log.info("flying at %.0f %% of its speed: %.1f m/s per axis, for %.0f s", 100 * level, bounds.max(), seconds)
        vehicle.wait(vehicle.current_period.number + 1)
        self._cut()
        end = self._periods + max(round(seconds / robot.period), 2 * PIECE)  # one trajectory to fit, one to hold out
        while self._periods < end:
            for wanted in self._next(level):
                if self._period(wanted, bounds):
                    break
        self._cut()
        vehicle.wait(vehicle.current_period.number + 5)

    def _next(self, level: float) -> list[Array]:
        period = self._vehicle.current_period
        return draw_leg(self._robot, self._box, level, period.report.measured, period.input, self._rng)

    def _period(self, wanted: Array, level: Array) -> bool:
        """Fly one period; return True if the leg must end (box rule or gap). Raises FlightEnded."""
        vehicle, before = self._vehicle, self._vehicle.current_period
        allowed = self._box.constrain(before.report.measured, wanted, level)
        vehicle.commit(allowed[None], before.number + 1)
        period = vehicle.wait(before.number + 1)
        state = period.report.measured
        self._periods += 1
        if period.number != before.number + 1 or period.lost:
            self._cut()
            if period.lost:
                self._wait_for_link()
            return True
        if self._built is None:
            self._built = TrajectoryBuilder(state, before.input)
        else:
            self._built.add(before.input, state, period.report.subsamples)
            if len(self._built) >= PIECE:
                self._cut()
        if (outside := self._box.outside(state)) > OUTSIDE:
            raise FlightEnded(f"it left its box by {outside:.0f} m: it does not follow its setpoints")
        if self._stop():
            raise FlightEnded("the flight was stopped")
        return bool((allowed != wanted).any())

    def _cut(self) -> None:
        """End the trajectory, so that no later sample follows its last one."""
        if self._built is not None and len(self._built) > 2:
            self._flown.append(self._built.trajectory())
            self._keep(self._dataset)
        self._built = None

    def _dataset(self) -> Dataset:
        data = Dataset(self._robot.in_lockstep(), tuple(self._flown), self._about)
        data.check()
        return data

    def _wait_for_link(self) -> None:
        """Hover while telemetry is lost or a pilot has taken over. Raises FlightEnded after 10 s."""
        for _ in range(round(10.0 / self._robot.period)):
            if not self._vehicle.wait(self._vehicle.current_period.number + 1).lost:
                return
        raise FlightEnded(f"no control of the vehicle for 10 s: {self._vehicle.current_period.lost}")

    def _prediction_error(self) -> float:
        """Return the 95 % quantile in m of the errors of a linear fit on held-out data, `AHEAD` periods ahead."""
        try:
            fitted, held_out = (windows(part, AHEAD, FREE) for part in self._dataset().split((0.5, 0.5)))
        except BadData:
            return math.inf
        if min(len(fitted), len(held_out)) < fitted.z.shape[1]:
            return math.inf
        C = np.linalg.lstsq(fitted.z, fitted.y[:, :3], rcond=None)[0]
        return float(np.quantile(np.linalg.norm(held_out.y[:, :3] - held_out.z @ C, axis=1), 0.95))

    def _drift(self) -> float:
        """Return the 95 % quantile in m of position minus integrated velocity over `AHEAD` periods."""
        errors = [np.zeros((1, 3))]
        for t in self._flown:
            position, velocity = t.states[:, :3], t.states[:, 3:6]
            by_velocity = np.cumsum(0.5 * self._robot.period * (velocity[1:] + velocity[:-1]), axis=0)
            error = position[1:] - by_velocity
            errors.append(error[AHEAD:] - error[:-AHEAD])
        return float(np.quantile(np.linalg.norm(np.concatenate(errors), axis=1), 0.95))

    def _model(self, data: Dataset, missing: list[str]) -> tuple[ModelSet, ValidationReport] | tuple[None, None]:
        """Certify the data."""
        try:
            config = ModelConfig(mode=ONE_STEP).of_minutes()
            return certify_supported(replace(data, robot=self._robot), config)[:2]
        except (BadData, Unsupported) as error:
            missing.append(f"the data support no model set: {error}")
            return None, None
