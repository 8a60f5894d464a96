"""The quadrotor's flight controller: velocity setpoint -> acceleration -> attitude and thrust -> body rates -> rotors.

Scalar code: at these sizes NumPy costs ten times as much. ENU, SI units; body axes x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

Vector = tuple[float, float, float]

GRAVITY = 9.81  # m/s²
STOPPED = 0.05  # m/s; a reference slower than this, with nothing more asked, is at rest
STILL: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Airframe:
    """What the controller knows of the airframe (sim/quadrotor.xml)."""

    mass: float = 1.2  # kg
    inertia: Vector = (0.009, 0.009, 0.016)  # kg m²
    arm: float = 0.12  # m, of each rotor along x and along y
    rotor_torque: float = 0.016  # m, torque about z for a newton of thrust
    least_thrust: float = 0.1  # N, a rotor
    most_thrust: float = 8.8  # N, a rotor
    drag_linear: float = 0.15  # 1/s, of the speed through the air, by mass
    drag_quadratic: float = 0.02  # 1/m


@dataclass(frozen=True)
class Gains:
    """How it flies. Times in s, limits in SI units."""

    ramp: float = 0.2  # the setpoint is averaged over this time: the period of those who send one
    round: float = 0.4  # and once more over this
    ease: float = 0.06  # and a third time
    attitude_lag: float = 0.03  # how late a wanted horizontal acceleration comes
    thrust_lag: float = 0.02  # and a vertical one
    velocity: float = 4.0  # 1/s
    integral: float = 2.0  # 1/s²
    integral_limit: float = 4.0  # m/s²
    position: float = 1.5  # 1/s, in hold
    attitude: float = 16.0  # 1/s
    rate: float = 30.0  # 1/s
    yaw: float = 3.0  # 1/s
    yaw_rate_limit: float = 1.5  # rad/s
    tilt_limit: float = 1.0  # rad
    rate_limit: float = 8.0  # rad/s
    known_drag: float = 0.9  # share of the drag that is known beforehand
    # A setpoint may jump by `jump`; what is more is made up for at `acceleration`. A robot's own slew, 0.8 m/s every
    # 0.2 s, passes unchanged, with some room for jitter
    acceleration: float = 4.2  # m/s²
    jump: float = 0.82  # m/s


class MovingAverage:
    """The mean of the last samples: `value`; what it gains from a sample to the next follows from `push`'s answer."""

    __slots__ = ("_samples", "_share", "_sum", "value")

    def __init__(self, samples: int) -> None:
        self._samples = deque([0.0] * samples)
        self._share = 1.0 / samples
        self.fill(0.0)

    def fill(self, value: float) -> None:
        """As if that had been the value for long."""
        samples = len(self._samples)
        self._samples = deque([value] * samples)
        self._sum, self.value = value * samples, value

    def push(self, value: float) -> float:
        """Take in a sample; returns how much the new mean differs from the old one."""
        change = value - self._samples.popleft()
        self._samples.append(value)
        self._sum += change
        self.value = self._sum * self._share
        return change * self._share


class VelocityAxis:
    """One axis of the outer loop: reference, velocity control, hold.

    The reference is the setpoint averaged over `ramp`, that over `round`, and that over `ease`. Stairs of a step every
    `ramp` seconds become a straight line, so acceleration has no ripple; `round` bounds jerk and `ease` snap; and the
    past is forgotten after the sum of the three, which makes the closed loop nearly linear and of short memory.
    """

    __slots__ = (
        "_allowance", "_eased", "_gains", "_jerk", "_late", "_period", "_ramped", "_rounded", "_velocity", "hold",
        "integral", "target", "velocity",
    )  # fmt: skip

    def __init__(self, gains: Gains, period: float, lag: float) -> None:
        """period: s between two updates; lag: s until a commanded acceleration is there."""
        self._gains, self._period = gains, period
        self._ramped, self._rounded = (
            MovingAverage(round(gains.ramp / period)),
            MovingAverage(round(gains.round / period)),
        )
        self._eased, self._jerk = MovingAverage(round(gains.ease / period)), MovingAverage(round(gains.ease / period))
        self._late = deque([0.0] * max(round(lag / period), 1))
        self.integral = 0.0
        self.reset(0.0)

    def reset(self, velocity: float) -> None:
        """Follow this velocity [m/s] as if it had been the setpoint for long; the integral stays."""
        self.target = self.velocity = self._velocity = velocity
        self._ramped.fill(velocity)
        for mean in (self._rounded, self._eased, self._jerk):
            mean.fill(0.0)
        self._late = deque([velocity] * len(self._late))
        self._allowance = self._gains.jump
        self.hold: float | None = None  # m, the position to be held

    def follow(self, setpoint: float) -> tuple[float, float]:
        """Move the reference for one period; returns its jerk, m/s³, and snap, m/s⁴."""
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
        """What to command, m/s², without gravity and drag, seeing an estimated position and velocity."""
        g = self._gains
        wanted = self.velocity
        if self.hold is not None:
            wanted += g.position * (self.hold - position)
        error = wanted - velocity
        integral = self.integral + g.integral * self._period * error
        self.integral = min(max(integral, -g.integral_limit), g.integral_limit)
        return self._eased.value + g.velocity * error + self.integral


class FlightController:
    """Flies velocity setpoints; a setpoint of zero ends in holding the position.

    setpoint: (x, y, z) m/s; yaw: rad from east, the heading to keep; yaw_rate: rad/s at which it turns on.
    """

    def __init__(
        self, period: float, outer_every: int, gains: Gains | None = None, body: Airframe | None = None
    ) -> None:
        """period: s between two updates; outer_every: updates of attitude and rates for one of the velocity loop."""
        self.gains, self.body = gains or Gains(), body or Airframe()
        self._period, self._outer_every = period, outer_every
        outer = period * outer_every
        g = self.gains
        self.x, self.y, self.z = (VelocityAxis(g, outer, lag) for lag in (g.attitude_lag, g.attitude_lag, g.thrust_lag))
        self.reset()

    def reset(self, yaw: float = 0.0) -> None:
        """Stand still, as if switched on now."""
        self.setpoint: Vector = STILL
        self.yaw, self.yaw_goal, self.yaw_rate = yaw, yaw, 0.0
        self._turn = 0.0  # rad/s of the yaw's reference
        for axis in (self.x, self.y, self.z):
            axis.reset(0.0)
            axis.integral = 0.0
        self._force: Vector = (0.0, 0.0, GRAVITY)
        self._force_rate = self._force_curve = STILL
        self._count = 0

    @property
    def holding(self) -> bool:
        """It holds a position."""
        return self.x.hold is not None

    def update(
        self, position: Vector, velocity: Vector, attitude: tuple[float, float, float, float], rates: Vector
    ) -> tuple[float, float, float, float]:
        """Thrusts [N] of the four rotors from the estimated state.

        position [m], velocity [m/s]: in the world; attitude: quaternion (w, x, y, z), world from body; rates: of the
        body about its own axes, rad/s.
        """
        if self._count == 0:
            self._count = self._outer_every
            self._velocity_loop(position, velocity)
        self._count -= 1
        return self._attitude_loop(attitude, rates)

    def _velocity_loop(self, position: Vector, velocity: Vector) -> None:
        """Bring the wanted specific force, and its rate of change, up to date."""
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
        """Turn the yaw's reference towards its goal, no faster than allowed."""
        limit = self.gains.yaw_rate_limit
        if self.yaw_rate:
            self.yaw_goal = self.yaw + self.yaw_rate * period
        way = math.remainder(self.yaw_goal - self.yaw, math.tau)
        self._turn = min(max(way / period, -limit), limit)
        self.yaw += self._turn * period

    def _attitude_loop(
        self, attitude: tuple[float, float, float, float], rates: Vector
    ) -> tuple[float, float, float, float]:
        g, body = self.gains, self.body
        w, x, y, z = attitude
        fx, fy, fz = self._force
        jx, jy, jz = self._force_rate
        sx, sy, sz = self._force_curve
        xx, xy, xz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)  # body's x axis
        yx, yy, yz = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)  # its y axis
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
        lift = min(max(0.25 * body.mass * fz / upright, low + 0.5), high - 1.0)  # the height comes first
        # what a rotor cannot give is taken from the torques, not from the lift
        asked, room = abs(roll) + abs(pitch) + abs(turn), min(lift - low, high - lift)
        if asked > room:
            roll, pitch, turn = roll * room / asked, pitch * room / asked, turn * room / asked
        return (
            lift - roll - pitch - turn,
            lift + roll + pitch - turn,
            lift + roll - pitch + turn,
            lift - roll + pitch + turn,
        )
