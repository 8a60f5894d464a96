"""A robot without a position: a two-link arm in MuJoCo that must not leave its joint limits.

python examples/two_link_arm/two_link_arm.py                       # drive 10 minutes, certify, 200 adversary episodes
python examples/two_link_arm/two_link_arm.py --picture limits.png  # and draw where the arm went

The simulator is an independent program: Brakeline sees only the CSV log that it writes and, later, measured states.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from brakeline import Filter, InProcess, ModelSet, robot_named
from brakeline.deploy.cli import main as brakeline

DESCRIPTION = Path(__file__).with_name("two_link_arm.toml")
ROBOT = robot_named(str(DESCRIPTION))
STEP = 0.002  # s of the physics
STEPS_PER_ROW = 10  # physics steps between two rows of the log
REACH = np.array([1.7, 2.4])  # rad; the recording stays within these angles, which are a little beyond the limits
MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body gravcomp="1">
      <joint name="q1" axis="0 1 0" range="-2 2" limited="true" damping="0.2" frictionloss="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04" mass="2"/>
      <body pos="0.5 0 0" gravcomp="1">
        <joint name="q2" axis="0 1 0" range="-2.7 2.7" limited="true" damping="0.1" frictionloss="0.05"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="q1" kv="8" forcerange="-20 20"/>
    <velocity joint="q2" kv="3" forcerange="-8 8"/>
  </actuator>
</mujoco>
"""


class Arm:
    """The arm's physics and its encoders.

    Attributes:
        true (S, n): the true states in the last period, at every physics step.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._model = mujoco.MjModel.from_xml_string(MODEL)
        self._data = mujoco.MjData(self._model)
        self._generator = generator
        self.reset(np.zeros(2))

    def reset(self, joints: np.ndarray) -> None:
        """Stand at joint angles (2,) [rad]."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = joints
        mujoco.mj_forward(self._model, self._data)
        self.true = self._now()[None]

    def _now(self) -> np.ndarray:
        return np.concatenate([self._data.qpos, self._data.qvel])

    def measured(self, true: np.ndarray | None = None) -> np.ndarray:
        """Return a state (n,) with the errors of the description; by default the current one."""
        errors = self._generator.uniform(-1.0, 1.0, ROBOT.state_dim) * ROBOT.measurement_bound
        return (self.true[-1] if true is None else true) + errors

    def drive(self, velocities: np.ndarray) -> None:
        """Command joint velocities (2,) [rad/s] for one period."""
        self._data.ctrl[:] = velocities
        states = []
        for _ in range(round(ROBOT.period / STEP)):
            mujoco.mj_step(self._model, self._data)
            states.append(self._now())
        self.true = np.array(states)


def record(path: Path, minutes: float, generator: np.random.Generator) -> Path:
    """Drive the arm as an operator with a joystick would, and write the measured states and the inputs as CSV."""
    arm, held, left, time = Arm(generator), np.zeros(2), 0, 0.0
    with path.open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["time", "q1", "q2", "dq1", "dq2", "w1", "w2"])
        while time < 60.0 * minutes:
            if left == 0:
                held, left = generator.uniform(ROBOT.low(), ROBOT.high()), int(generator.integers(3, 15))
                kind = generator.choice(["stop", "full speed", "restless", "smooth"], p=[0.15, 0.15, 0.5, 0.2])
                if kind == "stop":
                    held, left = np.zeros(2), 10
                elif kind == "full speed":
                    held = np.sign(held) * ROBOT.high()
                elif kind == "restless":
                    held, left = np.sign(held) * ROBOT.high(), int(generator.integers(1, 3))
            left -= 1
            joints = arm.measured()[:2]
            command = np.clip(held, 3.0 * (-REACH - joints), 3.0 * (REACH - joints)) if held.any() else held
            command = np.clip(command, ROBOT.low(), ROBOT.high())
            start = arm.true[-1:]
            arm.drive(command)
            for i, true in enumerate(np.concatenate([start, arm.true])[:-1:STEPS_PER_ROW]):
                row = np.concatenate([arm.measured(true), command])
                log.writerow([f"{time + i * STEPS_PER_ROW * STEP:.3f}", *(f"{value:.6f}" for value in row)])
            time += ROBOT.period
    return path


def certify(log: Path, folder: Path, accept_bound: float) -> ModelSet:
    """Import the log and certify a model set, with the two commands that a user types."""
    os.environ["BRAKELINE_DATA"] = str(folder / "data")
    robot = str(DESCRIPTION)
    accepting = ["--accept-bound", str(accept_bound)]
    for command in (["import", str(log), "--robot", robot], ["certify", robot, "--use", *accepting]):
        if brakeline(command):
            raise SystemExit(f"brakeline {command[0]} failed")
    return ModelSet.load(folder / "data" / ROBOT.name / "residual-one-step.safetensors")


class Adversary:
    """Drives at the limits: full speed towards a corner, jumps between the bounds, and creeping."""

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator, self._left, self._held = generator, 0, np.zeros(2)

    def __call__(self) -> np.ndarray:
        if self._left == 0:
            self._left = int(self._generator.choice([1, 5, 30]))
            share = self._generator.choice([0.1, 1.0], p=[0.2, 0.8])
            self._held = share * ROBOT.high() * self._generator.choice([-1.0, 1.0], 2)
        self._left -= 1
        return self._held


def attack(safety: InProcess | None, episodes: int, steps: int, seed: int) -> tuple[dict[str, float], np.ndarray]:
    """Let the adversary drive, with the filter or without it.

    Returns:
        Figures, and the true joint angles (T, 2) at every tenth physics step.
    """
    generator = np.random.default_rng(seed)
    arm, kinds, excesses, beyond, times, joints = Arm(generator), [], [], 0, [], []
    limits = np.array([limit.most for limit in ROBOT.limits])
    for _ in range(episodes):
        while True:  # a start well within the limits
            start = generator.uniform([-1.4, -2.1], [1.4, 2.1])
            if start.sum() < 2.6:
                break
        arm.reset(start)
        adversary, excess = Adversary(generator), -np.inf  # of an episode, beyond its nearest limit [rad]
        if safety is not None:
            safety.reset()
        for _ in range(steps):
            action = adversary()
            if safety is not None:
                answer = safety.decide(arm.measured(), action)  # no obstacles: the arm has only limits
                kinds.append(answer.kind)
                times.append(answer.time_ms)
                action = answer.action
            arm.drive(action)
            excess = max(excess, float((arm.true @ ROBOT.limit_weights.T - limits).max()))
            joints.append(arm.true[::10, :2])
        excesses.append(excess)
        beyond += excess > 0.0
    figures = {"episodes": episodes, "steps": episodes * steps, "episodes beyond a limit": beyond}
    figures |= {"most beyond a limit [rad]": max(excesses)} if beyond else {"nearest to a limit [rad]": -max(excesses)}
    if kinds:
        figures["median nearest of an episode [rad]"] = -float(np.median(excesses))
        figures |= {kind: kinds.count(kind) for kind in sorted(set(kinds))}
        figures["median decision [ms]"] = float(np.median(times))
    return figures, np.concatenate(joints)


def draw(path: Path, with_filter: np.ndarray, without: np.ndarray) -> None:
    """Plot where the arm went in joint space, with the filter and without it."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9.0, 4.2), sharex=True, sharey=True, layout="constrained")
    for axis, joints, title in zip(axes, (with_filter, without), ("with the filter", "without it"), strict=True):
        axis.plot(*joints.T, ",", alpha=0.4)
        line = np.linspace(-4.0, 4.0, 2)
        for limit in ROBOT.limits:
            a, b = limit.weights[:2]
            points = (line, (limit.most - a * line) / b) if b else (np.full(2, limit.most / a), line)
            axis.plot(*points, "r-", linewidth=1.0)
        axis.set(xlim=(-2.1, 2.1), ylim=(-2.9, 2.9), title=title, xlabel="shoulder q1 [rad]")
    axes[0].set_ylabel("elbow q2 [rad]")
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="Minutes of driving to record.")
    parser.add_argument("--episodes", type=int, default=200, help="Episodes of the adversary.")
    parser.add_argument("--steps", type=int, default=100, help="Periods in an episode.")
    parser.add_argument("--accept-bound", type=float, default=0.01, help="Largest share of plans outside their tubes.")
    parser.add_argument("--picture", type=Path, help="Draw where the arm went into this image.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = record(folder / "drive.csv", options.minutes, np.random.default_rng(0))
        model = certify(log, folder, options.accept_bound)
    safety = InProcess(Filter(model), options.accept_bound)
    behind, filtered = attack(safety, options.episodes, options.steps, seed=1)
    print("behind the filter:", behind)
    free, unfiltered = attack(None, min(options.episodes, 20), options.steps, seed=1)
    print("without it:", free)
    if options.picture is not None:
        draw(options.picture, filtered, unfiltered)


if __name__ == "__main__":
    main()
