"""The quadrotor's flight controller, the drag of the air, and free flight, for compiled loops over many vehicles.

`brakeline.sim.flight_controller` explains the controller. ENU, SI units; body axes x forward, y left, z up.

Arguments that functions share:

    c            one controller, a record of a `recarray` of `CONTROLLER`
    qpos (7,)    position [m] and attitude (w, x, y, z; world from body), as MuJoCo has them
    qvel (6,)    velocity [m/s] in the world and body rates [rad/s]
    errors (9,)  of the estimated position [m], velocity [m/s] and attitude [rad]

`tests/sim/flight_controller_twin.py` has the controller in plain Python, and MuJoCo simulates free flight.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brakeline.compilation import compiled

Array = NDArray[np.float64]
Record = Any  # one record of `CONTROLLER`

GRAVITY = 9.81  # m/s²
STOPPED = 0.05  # m/s; below this speed, and at the setpoint zero, the reference is at rest
TIMESTEP = 0.005  # s, of the physics and of the attitude loop
OUTER_EVERY = 2  # physics steps for one step of the velocity loop
OUTER = TIMESTEP * OUTER_EVERY  # s
STEPS_OF_TICK = 4  # physics steps of a tick of the autopilot


class Airframe(NamedTuple):
    """The airframe as the controller knows it (sim/quadrotor.xml)."""

    mass: float = 1.2  # kg
    inertia: tuple[float, float, float] = (0.009, 0.009, 0.016)  # kg m²
    arm: float = 0.12  # m, of each rotor along x and along y
    rotor_torque: float = 0.016  # m, torque about z per thrust
    rotor_lag: float = 0.02  # s, of the thrust behind its command
    least_thrust: float = 0.1  # N, a rotor
    most_thrust: float = 8.8  # N, a rotor
    drag_linear: float = 0.15  # 1/s, drag per mass and airspeed
    drag_quadratic: float = 0.02  # 1/m, drag per mass and squared airspeed


class Gains(NamedTuple):
    """The gains of all loops. Times in s, limits in SI units."""

    ramp: float = 0.2  # averaging time of the setpoint: the period of its sender
    round: float = 0.4  # of the second average
    ease: float = 0.06  # of the third
    lags: tuple[float, float, float] = (0.03, 0.03, 0.02)  # delay of an acceleration along x, y and z
    velocity: float = 4.0  # 1/s
    integral: float = 2.0  # 1/s²
    integral_limit: float = 4.0  # m/s²
    position: float = 1.5  # 1/s, while holding
    attitude: float = 16.0  # 1/s
    rate: float = 30.0  # 1/s
    yaw: float = 3.0  # 1/s
    yaw_rate_limit: float = 1.5  # rad/s
    tilt_limit: float = 1.0  # rad
    rate_limit: float = 8.0  # rad/s
    known_drag: float = 0.9  # share of the drag in the feedforward
    # A setpoint may jump by `jump`; a larger change continues at `acceleration`. The robot's own slew, 0.8 m/s every
    # 0.2 s, passes unchanged, with some room for jitter.
    acceleration: float = 4.2  # m/s²
    jump: float = 0.82  # m/s


AIRFRAME, GAINS = Airframe(), Gains()
RAMP, ROUND, EASE = (round(time / OUTER) for time in (GAINS.ramp, GAINS.round, GAINS.ease))  # samples of the averages
LAGS = tuple(max(round(lag / OUTER), 1) for lag in GAINS.lags)  # samples

# One controller. Arrays of averages and of the delay have a row for each sample, and a column for each axis.
CONTROLLER = np.dtype(
    [
        ("setpoint", "f8", 3),  # m/s
        ("yaw", "f8"),  # rad from east, the reference of the heading
        ("yaw_goal", "f8"),  # rad from east, which the reference turns to
        ("yaw_rate", "f8"),  # rad/s; if not zero, the reference turns at this rate
        ("turn", "f8"),  # rad/s, of the reference
        ("target", "f8", 3),  # m/s, the setpoint after the limit of its jumps
        ("allowance", "f8", 3),  # m/s, by which the target may change now
        ("ramped", "f8", (RAMP, 3)),
        ("rounded", "f8", (ROUND, 3)),
        ("eased", "f8", (EASE, 3)),
        ("jerk", "f8", (EASE, 3)),
        ("sums", "f8", (4, 3)),  # of these four
        ("reference", "f8", 3),  # m/s
        ("delayed", "f8", (max(LAGS), 3)),  # m/s, the last references
        ("velocity", "f8", 3),  # m/s, the reference, delayed by the lag of the acceleration
        ("integral", "f8", 3),  # m/s², the integral term
        ("hold", "f8", 3),  # m, the position to hold, if it holds one
        ("holds", "i8"),  # whether it holds a position
        ("force", "f8", (3, 3)),  # wanted specific force, its rate, and the rate's rate
        ("outer", "i8"),  # steps of the velocity loop so far
        ("until", "i8"),  # steps of the attitude loop until the next one of the velocity loop
    ],
    align=True,
)


@compiled()
def _push(samples: Array, sums: Array, axis: int, place: int, value: float) -> float:
    """Replace the oldest sample of a moving average, and return the change of the average."""
    size = len(samples)
    slot = place % size
    change: float = value - samples[slot, axis]
    samples[slot, axis] = value
    sums[axis] += change
    return change * (1.0 / size)


@compiled()
def _follow(c: Record, axis: int) -> tuple[float, float, float]:
    """Move the reference of an axis on; return its acceleration [m/s²], jerk [m/s³] and snap [m/s⁴]."""
    g, place = GAINS, c.outer
    allowance = min(c.allowance[axis] + g.acceleration * OUTER, g.jump)
    change = min(max(c.setpoint[axis] - c.target[axis], -allowance), allowance)
    c.target[axis] += change
    c.allowance[axis] = allowance - abs(change)
    slope = _push(c.ramped, c.sums[0], axis, place, c.target[axis]) / OUTER
    jerk = _push(c.rounded, c.sums[1], axis, place, slope) / OUTER
    _push(c.eased, c.sums[2], axis, place, c.sums[1, axis] * (1.0 / ROUND))
    snap = _push(c.jerk, c.sums[3], axis, place, jerk) / OUTER
    acceleration = c.sums[2, axis] * (1.0 / EASE)
    c.reference[axis] += acceleration * OUTER
    slot = place % LAGS[axis]
    c.velocity[axis] = c.delayed[slot, axis]
    c.delayed[slot, axis] = c.reference[axis]
    return acceleration, c.sums[3, axis] * (1.0 / EASE), snap


@compiled()
def _commanded(c: Record, axis: int, feedforward: float, position: float, velocity: float) -> float:
    """Return the commanded acceleration [m/s²] without gravity and drag, from estimated position and velocity."""
    g, wanted = GAINS, c.velocity[axis]
    if c.holds:
        wanted += g.position * (c.hold[axis] - position)
    error = wanted - velocity
    integral = c.integral[axis] + g.integral * OUTER * error
    integral = min(max(integral, -g.integral_limit), g.integral_limit)
    c.integral[axis] = integral
    commanded: float = feedforward + g.velocity * error + integral
    return commanded


@compiled()
def _steer_yaw(c: Record) -> None:
    """Turn the reference of the heading towards its goal, within the limit of the yaw rate."""
    limit = GAINS.yaw_rate_limit
    if c.yaw_rate != 0.0:
        c.yaw_goal = c.yaw + c.yaw_rate * OUTER
    c.turn = min(max(_remainder(c.yaw_goal - c.yaw) / OUTER, -limit), limit)
    c.yaw += c.turn * OUTER


@compiled()
def _remainder(angle: float) -> float:
    """Return the same angle in [-π, π], as `math.remainder` does."""
    turns: float = np.rint(angle / math.tau)
    return angle - math.tau * turns


@compiled()
def _velocity_loop(c: Record, qpos: Array, qvel: Array, errors: Array) -> None:
    """Update the wanted specific force and its first two derivatives."""
    g, feedforward = GAINS, np.empty(3)
    for axis in range(3):
        feedforward[axis], c.force[1, axis], c.force[2, axis] = _follow(c, axis)
    c.outer += 1
    v = c.velocity
    if c.setpoint[0] != 0.0 or c.setpoint[1] != 0.0 or c.setpoint[2] != 0.0:
        c.holds = 0
    elif not c.holds and abs(v[0]) < STOPPED and abs(v[1]) < STOPPED and abs(v[2]) < STOPPED:
        c.holds = 1
        for axis in range(3):
            c.hold[axis] = qpos[axis] + errors[axis]
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    drag = g.known_drag * (AIRFRAME.drag_linear + AIRFRAME.drag_quadratic * speed)
    force = c.force[0]
    for axis in range(3):
        position, velocity = qpos[axis] + errors[axis], qvel[axis] + errors[3 + axis]
        force[axis] = _commanded(c, axis, feedforward[axis], position, velocity) + drag * v[axis]
    force[2] = max(force[2] + GRAVITY, 0.2 * GRAVITY)
    steepest = math.tan(g.tilt_limit) * force[2]
    level = math.hypot(force[0], force[1])
    if level > steepest:
        force[0], force[1] = force[0] * steepest / level, force[1] * steepest / level
    _steer_yaw(c)


@compiled()
def _attitude_loop(c: Record, qpos: Array, qvel: Array, thrusts: Array) -> None:
    """Write the rotors' thrusts [N] that turn the body towards the wanted force."""
    g, body = GAINS, AIRFRAME
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    fx, fy, fz = c.force[0, 0], c.force[0, 1], c.force[0, 2]
    jx, jy, jz = c.force[1, 0], c.force[1, 1], c.force[1, 2]
    sx, sy, sz = c.force[2, 0], c.force[2, 1], c.force[2, 2]
    # the body's x and y axes in the world
    xx, xy, xz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    yx, yy, yz = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)
    upright = max(1.0 - 2.0 * (x * x + y * y), 0.3)  # cosine of the tilt
    # the wanted force in the body's axes
    bx, by = xx * fx + xy * fy + xz * fz, yx * fx + yy * fy + yz * fz
    size = math.sqrt(fx * fx + fy * fy + fz * fz)
    limit = g.rate_limit
    p = -g.attitude * by / size - (yx * jx + yy * jy + yz * jz) / size
    q = g.attitude * bx / size + (xx * jx + xy * jy + xz * jz) / size
    r = g.yaw * _remainder(c.yaw - math.atan2(xy, xx)) + c.turn
    p, q = min(max(p, -limit), limit), min(max(q, -limit), limit)
    ix, iy, iz = body.inertia
    p_dot, q_dot = -(yx * sx + yy * sy + yz * sz) / size, (xx * sx + xy * sy + xz * sz) / size
    roll = ix * (g.rate * (p - qvel[3]) + p_dot) / (4.0 * body.arm)
    pitch = iy * (g.rate * (q - qvel[4]) + q_dot) / (4.0 * body.arm)
    turn = 0.3 * g.rate * iz * (r - qvel[5]) / (4.0 * body.rotor_torque)
    turn = min(max(turn, -1.0), 1.0)
    low, high = body.least_thrust, body.most_thrust
    lift = min(max(0.25 * body.mass * fz / upright, low + 0.5), high - 1.0)  # height has priority
    # at the rotors' limits, reduce the torques, not the lift
    needed, room = abs(roll) + abs(pitch) + abs(turn), min(lift - low, high - lift)
    if needed > room:
        roll, pitch, turn = roll * room / needed, pitch * room / needed, turn * room / needed
    thrusts[0] = lift - roll - pitch - turn
    thrusts[1] = lift + roll + pitch - turn
    thrusts[2] = lift + roll - pitch + turn
    thrusts[3] = lift - roll + pitch + turn


@compiled()
def control(controllers: Any, qpos: Array, qvel: Array, errors: Array, thrusts: Array) -> None:
    """Update the first controller, and write the thrusts (4,) [N] that it commands."""
    c = controllers[0]
    if c.until == 0:
        c.until = OUTER_EVERY
        _velocity_loop(c, qpos, qvel, errors)
    c.until -= 1
    _attitude_loop(c, qpos, qvel, thrusts)


@compiled()
def add_drag(qvel: Array, wind: Array, force: Array) -> None:
    """Write the air's drag into the first three of `force` [N]. wind (3,): m/s."""
    body = AIRFRAME
    vx, vy, vz = qvel[0] - wind[0], qvel[1] - wind[1], qvel[2] - wind[2]
    drag = body.mass * (body.drag_linear + body.drag_quadratic * math.sqrt(vx * vx + vy * vy + vz * vz))
    force[0], force[1], force[2] = -drag * vx, -drag * vy, -drag * vz


@compiled()
def _fly_freely(qpos: Array, qvel: Array, act: Array, thrusts: Array, force: Array) -> None:
    """Advance a vehicle that touches nothing by a physics step, as MuJoCo does.

    Args:
        act (4,): present thrusts of the rotors [N], which follow the commanded `thrusts` (4,).
        force (3,): on the centre of mass, without gravity [N].
    """
    body = AIRFRAME
    ix, iy, iz = body.inertia
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    lift = act[0] + act[1] + act[2] + act[3]
    roll = body.arm * (-act[0] + act[1] + act[2] - act[3])
    pitch = body.arm * (-act[0] + act[1] - act[2] + act[3])
    turn = body.rotor_torque * (-act[0] - act[1] + act[2] + act[3])
    share = 1.0 - math.exp(-TIMESTEP / body.rotor_lag)
    for rotor in range(4):
        act[rotor] += (min(max(thrusts[rotor], 0.0), body.most_thrust) - act[rotor]) * share
    up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
    for axis in range(3):
        qvel[axis] += TIMESTEP * (lift * up[axis] + force[axis]) / body.mass
    qvel[2] -= TIMESTEP * GRAVITY
    p, q, r = qvel[3], qvel[4], qvel[5]
    qvel[3] += TIMESTEP * (roll - (iz - iy) * q * r) / ix
    qvel[4] += TIMESTEP * (pitch - (ix - iz) * r * p) / iy
    qvel[5] += TIMESTEP * (turn - (iy - ix) * p * q) / iz
    for axis in range(3):
        qpos[axis] += TIMESTEP * qvel[axis]
    _turn_by(qpos, TIMESTEP * qvel[3], TIMESTEP * qvel[4], TIMESTEP * qvel[5])


@compiled()
def _turn_by(qpos: Array, a: float, b: float, c: float) -> None:
    """Turn an attitude by a rotation vector (a, b, c) in the body's axes [rad]."""
    angle = math.sqrt(a * a + b * b + c * c)
    share = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    u, a, b, c = math.cos(0.5 * angle), share * a, share * b, share * c
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    w, x, y, z = (
        w * u - x * a - y * b - z * c,
        w * a + x * u + y * c - z * b,
        w * b - x * c + y * u + z * a,
        w * c + x * b - y * a + z * u,
    )
    size = math.sqrt(w * w + x * x + y * y + z * z)
    qpos[3], qpos[4], qpos[5], qpos[6] = w / size, x / size, y / size, z / size


@compiled()
def fly(controllers: Any, coordinates: Array, errors: Array, path: Array, accelerations: Array) -> None:
    """Fly vehicles that touch nothing in calm air, each for as many ticks as `path` has.

    Args:
        controllers (R,): records of `CONTROLLER`.
        coordinates (R, 17): qpos, qvel and act.
        errors (R, K, 9): in each step of the velocity loop.
        path (R, T, 3): is filled with the positions after each tick [m].
        accelerations (R, 3): are filled with the means over the last physics step [m/s²].
    """
    thrusts, force, wind, before = np.empty(4), np.empty(3), np.zeros(3), np.empty(3)
    for row in range(len(controllers)):
        one = controllers[row : row + 1]
        qpos, qvel, act = coordinates[row, :7], coordinates[row, 7:13], coordinates[row, 13:]
        for step in range(path.shape[1] * STEPS_OF_TICK):
            before[:] = qvel[:3]
            control(one, qpos, qvel, errors[row, step // OUTER_EVERY], thrusts)
            add_drag(qvel, wind, force)
            _fly_freely(qpos, qvel, act, thrusts, force)
            if step % STEPS_OF_TICK == STEPS_OF_TICK - 1:
                path[row, step // STEPS_OF_TICK] = qpos[:3]
        accelerations[row] = (qvel[:3] - before) / TIMESTEP


def prepare() -> None:
    """Compile or load the loops, which otherwise the first flight waits for."""
    one, three = np.zeros(1, CONTROLLER).view(np.recarray), np.zeros((1, 3))
    fly(one, np.zeros((1, 17)), np.zeros((1, 0, 9)), np.zeros((1, 0, 3)), three)
    control(one, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.zeros(6), np.zeros(9), np.zeros(4))
    add_drag(np.zeros(6), np.zeros(3), np.zeros(6))
