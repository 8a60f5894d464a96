"""Many quadrotors behind autopilots, each alone in its arena and in calm air: a period of all of them at once.

They move as quadrotors behind the embedded autopilot of `brakeline.deploy.quadrotor_vehicles`, which follows a velocity
setpoint a period, and reports in messages with single precision; but no message is sent. As long as a quadrotor touches
nothing, compiled code flies it (`flight_kernels`). One that may touch something in the period flies it again in a
MuJoCo model of its arena, which reports contacts.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.obstacle import Array
from brakeline.sim.arena import Arena
from brakeline.sim.batch.flight_estimator_batch import FlightEstimatorBatch
from brakeline.sim.batch.normal_streams import NormalStreams, Rows
from brakeline.sim.batch.vehicle_batch import PeriodBatch, VehicleBatch
from brakeline.sim.flight_controller import Controllers, controllers_at_rest
from brakeline.sim.kernels.flight_kernels import (
    AIRFRAME,
    GRAVITY,
    OUTER,
    OUTER_EVERY,
    STEPS_OF_TICK,
    TIMESTEP,
    add_drag,
    control,
    fly,
)
from brakeline.sim.quadrotor import QUADROTOR, SAMPLES, SETTLE, arena_model
from brakeline.sim.sim_conditions import Conditions

TICKS = round(QUADROTOR.period / (STEPS_OF_TICK * TIMESTEP))  # of the autopilot, in a period
OUTER_STEPS = round(QUADROTOR.period / OUTER)  # of the velocity loop, in a period
COORDINATES = 17  # position and attitude, velocities, thrusts
DOUBT = 0.02  # m; less than that, between two ticks, an acceleration of 30 m/s² bends a path


@dataclass(frozen=True)
class FlightBatch:
    """The true motion of quadrotors in one period."""

    path: Array  # (rows, T, 3): positions at the ticks [m]
    accelerations: Array  # (rows, 3): at the end, means over the last physics step [m/s²]
    collision: NDArray[np.bool_]  # (rows,): whether the quadrotor touched an obstacle in some physics step
    clearance: Array  # (rows, T): m, from the body to the nearest obstacle at the ticks


class QuadrotorBatch(VehicleBatch):
    """N quadrotors; see `Quadrotor` for their states and inputs."""

    robot, samples = QUADROTOR, SAMPLES

    def __init__(self, size: int, kind: ArenaKind, conditions: Conditions, streams: NormalStreams) -> None:
        """Prepare for `size` quadrotors.

        Args:
            kind: of the arenas.
            streams: the source of all sensor errors.
        """
        super().__init__(size, kind)
        self._controllers = controllers_at_rest(size)
        self._coordinates = np.zeros((size, COORDINATES))
        self._estimator = FlightEstimatorBatch(size, conditions.flight_noise, streams)
        self._arenas: list[Arena | None] = [None] * size
        self._near: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}

    def begin(self, rows: Rows, arenas: list[Arena], generators: list[np.random.Generator]) -> None:
        """Let quadrotors hover at the starts of their arenas for a while, as a single one does."""
        for row, arena in zip(rows.tolist(), arenas, strict=True):
            self._near.pop(row, None)
            self._arenas[row] = arena
            self.obstacles.put(row, arena)
        starts = np.array([arena.start for arena in arenas]).reshape(-1, 3)
        resting = controllers_at_rest(len(rows))
        resting["hold"], resting["holds"] = starts, True
        self._controllers[rows] = resting
        self._coordinates[rows] = (0.0, 0.0, 0.0, 1.0, *[0.0] * 9, *[0.25 * AIRFRAME.mass * GRAVITY] * 4)
        self._coordinates[rows, :3], self.input[rows] = starts, 0.0
        self._estimator.begin(rows)
        for _ in range(SETTLE):
            self._estimator.begin_period(rows)
            motion = self.advance(rows)
        self._estimator.read(rows, self._coordinates[rows], motion.accelerations)  # before the first message
        self._measure(rows, motion)

    def set_input(self, rows: Rows, inputs: Array) -> None:
        before, slew = self.input[rows], QUADROTOR.slew
        self.input[rows] = np.clip(np.clip(inputs, before - slew, before + slew), QUADROTOR.low(), QUADROTOR.high())
        self._controllers["setpoint"][rows] = self.input[rows].astype(np.float32)  # as a message carries them
        self._estimator.begin_period(rows)

    def advance(self, rows: Rows) -> FlightBatch:
        errors = self._estimator.steps(rows, OUTER_STEPS)
        controllers, coordinates = self._controllers[rows], self._coordinates[rows]
        path, accelerations = np.empty((len(rows), TICKS, 3)), np.empty((len(rows), 3))
        collision = np.zeros(len(rows), dtype=bool)
        starts = coordinates[:, None, :3].copy()
        fly(controllers, coordinates, errors, path, accelerations)
        clearance = self.obstacles.clearance(rows, path) - QUADROTOR.footprint
        moves = np.linalg.norm(np.diff(path, axis=1, prepend=starts), axis=2)
        for i in np.flatnonzero((clearance < 0.5 * moves + DOUBT).any(axis=1)):
            row = int(rows[i])
            controllers[i], coordinates[i] = self._controllers[row], self._coordinates[row]
            path[i], accelerations[i], collision[i] = self._fly_in_arena(
                row, controllers[i : i + 1], coordinates[i], errors[i]
            )
            clearance[i] = self.obstacles.clearance(rows[i : i + 1], path[i : i + 1])[0] - QUADROTOR.footprint
        self._controllers[rows], self._coordinates[rows] = controllers, coordinates
        return FlightBatch(path, accelerations, collision, clearance)

    def finish(self, rows: Rows, motion: FlightBatch) -> PeriodBatch:
        before = self.measured[rows, None, :3]
        self._measure(rows, motion)
        path = self._estimator.path(rows, motion.path[:, TICKS // SAMPLES - 1 :: TICKS // SAMPLES]) - before
        states = self.measured[rows], self.true[rows]
        closest, clearance = motion.clearance.min(axis=1), motion.clearance[:, -1]
        return PeriodBatch(*states, motion.collision, closest, clearance, path, np.zeros(len(rows)))

    def _measure(self, rows: Rows, motion: FlightBatch) -> None:
        coordinates = self._coordinates[rows]
        self._clearance[rows] = motion.clearance[:, -1]
        self.true[rows] = np.column_stack([coordinates[:, :3], coordinates[:, 7:10], motion.accelerations])
        self.measured[rows] = self._estimator.read(rows, coordinates, motion.accelerations)

    def _fly_in_arena(
        self, row: int, controller: Controllers, coordinates: Array, errors: Array
    ) -> tuple[Array, Array, bool]:
        """Fly a quadrotor in its arena as `fly` does; return its path, its last acceleration, whether it collided."""
        if row not in self._near:
            arena = self._arenas[row]
            assert arena is not None, "no episode has begun"
            model = arena_model(arena, None)
            self._near[row] = model, mujoco.MjData(model)
        model, data = self._near[row]
        data.qpos[:], data.qvel[:], data.act[:] = coordinates[:7], coordinates[7:13], coordinates[13:]
        mujoco.mj_step1(model, data)
        collision, path, air, before = False, np.empty((TICKS, 3)), np.zeros(3), np.empty(3)
        for step in range(TICKS * STEPS_OF_TICK):
            before[:] = data.qvel[:3]
            control(controller, data.qpos, data.qvel, errors[step // OUTER_EVERY], data.ctrl)
            add_drag(data.qvel, air, data.qfrc_applied)
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            collision |= data.ncon > 0
            if step % STEPS_OF_TICK == STEPS_OF_TICK - 1:
                path[step // STEPS_OF_TICK] = data.qpos[:3]
        coordinates[:7], coordinates[7:13], coordinates[13:] = data.qpos, data.qvel, data.act
        return path, (data.qvel[:3] - before) / TIMESTEP, collision
