"""Many ground robots, each alone in its arena: one rollout of MuJoCo simulates a period of all of them.

As long as a robot touches nothing, the obstacles of its arena do not change its motion, but they cost two thirds of the
time of a step. So all robots take the period in one model without obstacles, in the threads of `mujoco.rollout`. A
robot that may touch something in the period takes it in the model of its own arena, where MuJoCo reports contacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import NDArray

from brakeline.messaging.arena_kinds import ArenaKind
from brakeline.messaging.obstacle import Array
from brakeline.sim.arena import Arena
from brakeline.sim.batch.ground_estimator_batch import GroundEstimatorBatch
from brakeline.sim.batch.normal_streams import NormalStreams, Rows
from brakeline.sim.batch.vehicle_batch import PeriodBatch, VehicleBatch
from brakeline.sim.driving_disturbances import DRAWS_AT_START, DRAWS_OF_SAMPLE, DrivingDisturbances
from brakeline.sim.floor_physics import FloorPhysics
from brakeline.sim.ground_robot import (
    COORDINATES,
    GROUND,
    MODEL,
    SAMPLE_TIME,
    SAMPLES,
    SPEEDS,
    WHEEL_RADIUS,
    WHEELS,
    YAW_RATE,
    TurtleBot,
    changes_of,
    weight,
    wheel_speeds,
)
from brakeline.sim.sim_conditions import Conditions

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
CONTROL = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED
BARE = Arena("bare", (), (0.0, 0.0, 0.0), (0.0, 0.0), 0.0, 1, ((-1.0, 1.0), (-1.0, 1.0)))
SAFE_GAP = 0.01  # m; the wheels turn too slowly to cover it between two samples


@dataclass(frozen=True)
class MotionBatch:
    """The true motion of robots in one period."""

    coordinates: Array  # (rows, S, 9): MuJoCo's, at the samples
    collision: NDArray[np.bool_]  # (rows,): whether the robot touched an obstacle in some physics step
    clearance: Array  # (rows, S): m, from the body to the nearest obstacle


class GroundBatch(VehicleBatch):
    """N ground robots; see `TurtleBot` for their states and inputs."""

    robot, samples = GROUND, SAMPLES

    def __init__(
        self, size: int, kind: ArenaKind, conditions: Conditions, threads: int, streams: NormalStreams
    ) -> None:
        """Prepare for `size` robots.

        Args:
            kind: of the arenas.
            threads: number of threads for the physics; 0: the calling thread.
            streams: the source of all sensor errors.
        """
        super().__init__(size, kind)
        self._conditions = conditions
        self._physics = self._floor_physics(BARE)
        model = self._physics.model
        self._rollout = Rollout(nthread=threads)
        self._data = [mujoco.MjData(model) for _ in range(max(1, threads))]
        self._steps = round(SAMPLE_TIME / model.opt.timestep)
        self._state, self._warmstart = np.zeros((size, mujoco.mj_stateSize(model, STATE))), np.zeros((size, SPEEDS))
        self._arenas: list[Arena] = [BARE] * size
        self._near: dict[int, FloorPhysics] = {}
        self._base = model.body("base").id
        self._draws = NormalStreams(size)
        self._disturbances = DrivingDisturbances(conditions.process_noise, size, SAMPLE_TIME)
        self._estimator = GroundEstimatorBatch(size, conditions.noise, streams, WHEEL_RADIUS, SAMPLE_TIME)

    def close(self) -> None:
        self._rollout.close()

    def begin(self, rows: Rows, arenas: list[Arena], generators: list[np.random.Generator]) -> None:
        """Place robots at the starts of their arenas, and let them settle on their wheels.

        generators: of the episodes. The disturbances come from generators spawned from them.
        """
        model, data = self._physics.model, self._physics.data
        for row, arena, generator in zip(rows.tolist(), arenas, generators, strict=True):
            self._draws.begin(row, generator.spawn(1)[0])
            self._near.pop(row, None)
            self._arenas[row] = arena
            self.obstacles.put(row, arena)
            x, y, heading = arena.start
            mujoco.mj_resetData(model, data)
            data.qpos[:7] = x, y, WHEEL_RADIUS, math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
            mujoco.mj_forward(model, data)
            mujoco.mj_getState(model, data, self._state[row], STATE)
            self._warmstart[row] = data.qacc_warmstart
        self._disturbances.begin(rows, self._draws.normal(rows, DRAWS_AT_START))
        self.input[rows] = 0.0
        starts = np.array([arena.start[:2] for arena in arenas]).reshape(-1, 1, 2)
        self._clearance[rows] = self.obstacles.clearance(rows, starts)[:, 0] - GROUND.footprint
        motion = self.advance(rows)
        self.true[rows] = self._true_states(rows)
        self._estimator.begin(rows, self.true[rows, :3], motion.coordinates[:, -1, WHEELS])
        self.measured[rows] = np.column_stack([self._estimator.pose[rows], np.zeros((len(rows), 2))])

    def set_input(self, rows: Rows, inputs: Array) -> None:
        self.input[rows] = np.clip(inputs, GROUND.low(), GROUND.high())

    def advance(self, rows: Rows) -> MotionBatch:
        reach = GROUND.period * np.maximum(self.input[rows, 0], np.abs(self.true[rows, 3])) + SAFE_GAP
        near = self._clearance[rows] < reach
        controls, forces = self._disturbed(rows)
        coordinates = np.empty((len(rows), SAMPLES, COORDINATES))
        clearance, collision = np.empty((len(rows), SAMPLES)), np.zeros(len(rows), dtype=bool)
        before = self._state[rows], self._warmstart[rows]
        if not near.all():
            far = rows[~near]
            coordinates[~near] = self._roll(far, controls[~near], forces[~near])
            clearance[~near] = self.obstacles.clearance(far, coordinates[~near, :, :2]) - GROUND.footprint
            near |= clearance.min(axis=1) < SAFE_GAP
        for i in np.flatnonzero(near):
            self._state[rows[i]], self._warmstart[rows[i]] = before[0][i], before[1][i]
            collision[i] = self._advance_in_arena(int(rows[i]), coordinates[i], controls[i], forces[i])
        if near.any():
            clearance[near] = self.obstacles.clearance(rows[near], coordinates[near, :, :2]) - GROUND.footprint
        self._clearance[rows] = clearance[:, -1]
        return MotionBatch(coordinates, collision, clearance)

    def finish(self, rows: Rows, motion: MotionBatch) -> PeriodBatch:
        headings = headings_of(motion.coordinates[..., 3:7])
        headings = np.column_stack([self.true[rows, 2], headings])
        rates = np.diff(np.unwrap(headings, axis=1), axis=1) * (SAMPLES / GROUND.period)
        self.true[rows] = self._true_states(rows)
        measured, path, turned = self._estimator.update(
            rows, motion.coordinates[..., WHEELS], rates, self.true[rows, :3]
        )
        self.measured[rows] = measured
        closest, clearance = motion.clearance.min(axis=1), motion.clearance[:, -1]
        return PeriodBatch(measured, self.true[rows], motion.collision, closest, clearance, path, turned)

    def _floor_physics(self, arena: Arena) -> FloorPhysics:
        """Compile the robot in an arena, under the conditions."""
        physics = FloorPhysics(MODEL, WHEEL_RADIUS, arena, SAMPLE_TIME, GROUND.period)
        robot = TurtleBot(arena, physics.model, physics.data)
        robot.alter(**changes_of(self._conditions))
        return physics

    def _disturbed(self, rows: Rows) -> tuple[Array, Array]:
        """Return the wheels' speeds [rad/s] and the forces on the base [N], (rows, S, 2) each: see `TurtleBot`."""
        draws = self._draws.normal(rows, SAMPLES * DRAWS_OF_SAMPLE).reshape(-1, SAMPLES, DRAWS_OF_SAMPLE)
        factors, tilts = self._disturbances.advance(rows, np.asarray(self.input[rows].any(axis=1)), draws)
        return wheel_speeds(self.input[rows])[:, None] * factors, weight(self._physics.model, self._base) * tilts

    def _roll(self, rows: Rows, controls: Array, forces: Array) -> Array:
        """Simulate a period without obstacles; return the coordinates (rows, S, 9) at the samples."""
        model = self._physics.model
        inputs = np.zeros((len(rows), SAMPLES, mujoco.mj_stateSize(model, CONTROL)))
        force = model.nu + 6 * self._base  # MuJoCo's order: controls, then a force and a torque on each body
        inputs[:, :, : model.nu], inputs[:, :, force : force + 2] = controls, forces
        states, _ = self._rollout.rollout(
            model,
            self._data,
            self._state[rows],
            np.repeat(inputs, self._steps, axis=1),
            control_spec=CONTROL,
            initial_warmstart=self._warmstart[rows],
        )
        self._state[rows] = states[:, -1]
        speeds = states[:, -2:, 1 + COORDINATES : 1 + COORDINATES + SPEEDS]
        # MuJoCo starts its solver from the last accelerations, which no rollout returns.
        self._warmstart[rows] = (speeds[:, 1] - speeds[:, 0]) / model.opt.timestep
        return np.asarray(states[:, self._steps - 1 :: self._steps, 1 : 1 + COORDINATES])

    def _advance_in_arena(self, row: int, coordinates: Array, controls: Array, forces: Array) -> bool:
        """Simulate a period of a robot in its arena, and fill in `coordinates` (S, 9). Return whether it collided."""
        if row not in self._near:
            self._near[row] = self._floor_physics(self._arenas[row])
        physics = self._near[row]
        model, data = physics.model, physics.data
        mujoco.mj_setState(model, data, self._state[row], STATE)
        data.qacc_warmstart[:] = self._warmstart[row]
        mujoco.mj_step1(model, data)
        collision = False
        for i in range(SAMPLES):
            data.ctrl[:], data.xfrc_applied[self._base, :2] = controls[i], forces[i]
            collision |= physics.advance(at_rest=False)
            coordinates[i] = data.qpos
        mujoco.mj_getState(model, data, self._state[row], STATE)
        self._warmstart[row] = data.qacc_warmstart
        return collision

    def _true_states(self, rows: Rows) -> Array:
        """Return the true states (rows, 5)."""
        coordinates = self._state[rows, 1 : 1 + COORDINATES]
        speeds = self._state[rows, 1 + COORDINATES : 1 + COORDINATES + SPEEDS]
        heading = headings_of(coordinates[:, 3:7])
        speed = speeds[:, 0] * np.cos(heading) + speeds[:, 1] * np.sin(heading)
        return np.column_stack([coordinates[:, :2], heading, speed, speeds[:, YAW_RATE]])


def headings_of(attitudes: Array) -> Array:
    """Return the headings (...) [rad] of attitudes (..., 4): `heading_of` for arrays."""
    w, x, y, z = np.moveaxis(attitudes, -1, 0)
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
