"""The twin of `sim/kernels/flight_kernels.py`: the quadrotor's flight controller in plain Python, with queues.

ENU, SI units; body axes x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections import deque

from brakeline.sim.kernels.flight_kernels import AIRFRAME, GAINS, GRAVITY, STOPPED, Gains

Vector = tuple[float, float, float]

STILL: Vector = (0.0, 0.0, 0.0)


class MovingAverage:
    """The moving average `value` of the last samples."""

    __slots__ = ("_samples", "_share", "_size", "_sum", "value")

    def __init__(self, samples: int) -> None:
        self._size, self._share = samples, 1.0 / samples
        self.fill(0.0)

    def fill(self, value: float) -> None:
        """Set all samples to one value."""
        self._samples = deque([value] * self._size)
        self._sum, self.value = value * self._size, value

    def push(self, value: float) -> float:
        """Add a sample; return the change of the average."""
        change = value - self._samples.popleft()
        self._samples.append(value)
        self._sum += change
        self.value = self._sum * self._share
        return change * self._share


class VelocityAxis:
    """One axis of the outer loop: reference, velocity control, hold.

    The reference is the setpoint after three moving averages in a row, over `ramp`, `round` and `ease` seconds. A
    staircase with a step every `ramp` seconds becomes a straight line, so the acceleration has no ripple. `round`
    bounds the jerk and `ease` the snap. The reference forgets the past after the sum of the three times, so the closed
    loop is nearly linear and has a short memory.

    Attributes:
        target: m/s, the setpoint after the limit of its jumps.
        velocity: m/s, the reference, delayed by the lag of the acceleration.
        integral: m/s², the integral term.
        hold: m, the position to hold; None while following a velocity.
    """

    __slots__ = (
        "_allowance", "_eased", "_gains", "_jerk", "_late", "_period", "_ramped", "_rounded", "_velocity", "hold",
        "integral", "target", "velocity",
    )  # fmt: skip

    def __init__(self, gains: Gains, period: float, lag: float) -> None:
        """Start at rest.

        Args:
            period: time between two updates [s].
            lag: time until the vehicle reaches a commanded acceleration [s].
        """
        self._gains, self._period = gains, period
        times = (gains.ramp, gains.round, gains.ease, gains.ease)
        self._ramped, self._rounded, self._eased, self._jerk = (MovingAverage(round(t / period)) for t in times)
        self._late = deque([0.0] * max(round(lag / period), 1))
        self.integral = 0.0
        self.reset(0.0)

    def reset(self, velocity: float) -> None:
        """Start in steady state at a velocity [m/s]; keep the integral."""
        self.target = self.velocity = self._velocity = velocity
        self._ramped.fill(velocity)
        for mean in (self._rounded, self._eased, self._jerk):
            mean.fill(0.0)
        self._late = deque([velocity] * len(self._late))
        self._allowance = self._gains.jump
        self.hold: float | None = None

    def follow(self, setpoint: float) -> tuple[float, float]:
        """Move the reference on by one period; return its jerk [m/s³] and snap [m/s⁴]."""
        g, period = self._gains, self._period
        allowance = min(self._allowance + g.acceleration * period, g.jump)
        change = min(max(setpoint - self.target, -allowance), allowance)
        self.target += change
        self._allowance = allowance - abs(change)
        slope = self._ramped.push(self.target) / period
        jerk = self._rounded.push(slope) / period
        self._eased.push(self._rounded.value)
        snap = self._jerk.push(jerk) / period
        self._velocity += self._eased.value * period
        self._late.append(self._velocity)
        self.velocity = self._late.popleft()
        return self._jerk.value, snap

    def acceleration(self, position: float, velocity: float) -> float:
        """Return the commanded acceleration [m/s²] without gravity and drag, from estimated position and velocity."""
        g = self._gains
        wanted = self.velocity
        if self.hold is not None:
            wanted += g.position * (self.hold - position)
        error = wanted - velocity
        integral = self.integral + g.integral * self._period * error
        self.integral = min(max(integral, -g.integral_limit), g.integral_limit)
        return self._eased.value + g.velocity * error + self.integral


class FlightController:
    """Follows velocity setpoints; at the setpoint zero, the vehicle stops and holds its position.

    Attributes:
        setpoint: (x, y, z) m/s.
        yaw: rad from east, the reference of the heading.
        yaw_goal: rad from east, the heading that the reference turns to.
        yaw_rate: rad/s; if not zero, the reference turns at this rate.
    """

    def __init__(self, period: float, outer_every: int) -> None:
        """Start at rest.

        Args:
            period: time between two updates [s].
            outer_every: updates of the attitude loop for each update of the velocity loop.
        """
        self.gains, self.body = GAINS, AIRFRAME
        self._period, self._outer_every = period, outer_every
        outer = period * outer_every
        g = self.gains
        self.x, self.y, self.z = (VelocityAxis(g, outer, lag) for lag in g.lags)
        self.reset()

    def reset(self, yaw: float = 0.0) -> None:
        """Start at rest with a heading [rad]."""
        self.setpoint: Vector = STILL
        self.yaw, self.yaw_goal, self.yaw_rate = yaw, yaw, 0.0
        self._turn = 0.0  # rad/s, of the yaw reference
        for axis in (self.x, self.y, self.z):
            axis.reset(0.0)
            axis.integral = 0.0
        self._force: Vector = (0.0, 0.0, GRAVITY)
        self._force_rate = self._force_curve = STILL
        self._count = 0

    def update(
        self, position: Vector, velocity: Vector, attitude: tuple[float, float, float, float], rates: Vector
    ) -> tuple[float, float, float, float]:
        """Return the thrusts [N] of the four rotors for an estimated state.

        Args:
            position: m, in the world.
            velocity: m/s, in the world.
            attitude: quaternion (w, x, y, z), world from body.
            rates: rad/s, of the body about its own axes.
        """
        if self._count == 0:
            self._count = self._outer_every
            self._velocity_loop(position, velocity)
        self._count -= 1
        return self._attitude_loop(attitude, rates)

    def _velocity_loop(self, position: Vector, velocity: Vector) -> None:
        """Update the wanted specific force and its first two derivatives."""
        g, x, y, z = self.gains, self.x, self.y, self.z
        px, py, pz = position
        ux, uy, uz = self.setpoint
        (jx, sx), (jy, sy), (jz, sz) = x.follow(ux), y.follow(uy), z.follow(uz)
        vx, vy, vz = x.velocity, y.velocity, z.velocity
        if ux or uy or uz:
            x.hold = y.hold = z.hold = None
        elif x.hold is None and abs(vx) < STOPPED and abs(vy) < STOPPED and abs(vz) < STOPPED:
            x.hold, y.hold, z.hold = px, py, pz
        drag = g.known_drag * (
            self.body.drag_linear + self.body.drag_quadratic * math.sqrt(vx * vx + vy * vy + vz * vz)
        )
        fx = x.acceleration(px, velocity[0]) + drag * vx
        fy = y.acceleration(py, velocity[1]) + drag * vy
        fz = z.acceleration(pz, velocity[2]) + drag * vz + GRAVITY
        fz = max(fz, 0.2 * GRAVITY)
        steepest = math.tan(g.tilt_limit) * fz
        level = math.hypot(fx, fy)
        if level > steepest:
            fx, fy = fx * steepest / level, fy * steepest / level
        self._force, self._force_rate, self._force_curve = (fx, fy, fz), (jx, jy, jz), (sx, sy, sz)
        self._steer_yaw(self._period * self._outer_every)

    def _steer_yaw(self, period: float) -> None:
        """Turn the yaw reference towards its goal, within the limit of the yaw rate."""
        limit = self.gains.yaw_rate_limit
        if self.yaw_rate:
            self.yaw_goal = self.yaw + self.yaw_rate * period
        remaining = math.remainder(self.yaw_goal - self.yaw, math.tau)
        self._turn = min(max(remaining / period, -limit), limit)
        self.yaw += self._turn * period

    def _attitude_loop(
        self, attitude: tuple[float, float, float, float], rates: Vector
    ) -> tuple[float, float, float, float]:
        """Return the rotors' thrusts [N] that turn the body towards the wanted force."""
        g, body = self.gains, self.body
        w, x, y, z = attitude
        fx, fy, fz = self._force
        jx, jy, jz = self._force_rate
        sx, sy, sz = self._force_curve
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
        r = g.yaw * math.remainder(self.yaw - math.atan2(xy, xx), math.tau) + self._turn
        p, q = min(max(p, -limit), limit), min(max(q, -limit), limit)
        ix, iy, iz = body.inertia
        p_dot, q_dot = -(yx * sx + yy * sy + yz * sz) / size, (xx * sx + xy * sy + xz * sz) / size
        roll = ix * (g.rate * (p - rates[0]) + p_dot) / (4.0 * body.arm)
        pitch = iy * (g.rate * (q - rates[1]) + q_dot) / (4.0 * body.arm)
        turn = 0.3 * g.rate * iz * (r - rates[2]) / (4.0 * body.rotor_torque)
        turn = min(max(turn, -1.0), 1.0)
        low, high = body.least_thrust, body.most_thrust
        lift = min(max(0.25 * body.mass * fz / upright, low + 0.5), high - 1.0)  # height has priority
        # at the rotors' limits, reduce the torques, not the lift
        needed, room = abs(roll) + abs(pitch) + abs(turn), min(lift - low, high - lift)
        if needed > room:
            roll, pitch, turn = roll * room / needed, pitch * room / needed, turn * room / needed
        return (
            lift - roll - pitch - turn,
            lift + roll + pitch - turn,
            lift + roll - pitch + turn,
            lift - roll + pitch + turn,
        )
