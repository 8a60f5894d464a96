"""Record random driving of the cart-pole as CSV. python record.py OUT.csv [MINUTES] [--disturbed]

The driving goes a little beyond the constraints, because the filter verifies nothing outside what was recorded.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.safe_control_gym.adapter import SAMPLES, SampledCartPole, make
from examples.safe_control_gym.velocity_loop import ROBOT, Array, force_of

SEED = 10_000  # none of the seeds of the episodes
REACH = 2.3  # m from the middle: the driver turns back there
RETURN = 0.8  # 1/s, largest commanded velocity outwards, for each meter before the end


class Driver:
    """Draws what to do next: a stop, one velocity, or a stretch of restless changes between the bounds."""

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator, self._high = generator, ROBOT.high()[0]
        self._stretch, self._left, self._held, self._restless = 0, 0, 0.0, False

    def __call__(self, state: Array) -> float:
        if self._stretch == 0:
            self._begin_stretch()
        if self._restless and self._left == 0:
            self._left = int(self._generator.integers(1, 4))
            self._held = self._high * self._generator.choice([-1.0, 1.0, self._generator.uniform(-1.0, 1.0)])
        self._stretch, self._left = self._stretch - 1, self._left - 1
        if self._held == 0.0:
            return 0.0
        low, high = RETURN * (-REACH - state[0]), RETURN * (REACH - state[0])
        return float(np.clip(np.clip(self._held, low, high), -self._high, self._high))

    def _begin_stretch(self) -> None:
        draw = self._generator
        kind = draw.choice(["stop", "full speed", "restless", "smooth"], p=[0.2, 0.2, 0.2, 0.4])
        long = kind in ("stop", "restless")
        self._stretch = ROBOT.horizon + 10 if long else int(draw.integers(3, 20))
        fastest, velocity = self._high * draw.choice([-1.0, 1.0]), draw.uniform(-self._high, self._high)
        self._held = {"stop": 0.0, "full speed": fastest}.get(kind, velocity)
        self._restless, self._left = kind == "restless", 0


def rows(env: SampledCartPole, driver: Driver, periods: int) -> list[list[float]]:
    """Drive for some periods from a stand. Return time, state and commanded velocity of every sample."""
    env.reset()
    log = []
    for k in range(periods):
        state = env.physical_state()
        velocity = driver(state)
        env.step(np.array([force_of(state, velocity)]))
        for i, sample in enumerate([state, *env.path[:-1]]):
            log.append([(k + i / SAMPLES) * ROBOT.period, *sample, velocity])
    return log


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("minutes", type=float, nargs="?", default=20.0)
    parser.add_argument("--disturbed", action="store_true", help="push the pole at random, as in the disturbed task")
    options = parser.parse_args()
    periods = round(60.0 * options.minutes / ROBOT.period)
    changes = {"done_on_out_of_bound": False, "episode_len_sec": 10**6, "constraints": None, "seed": SEED}
    env = make(disturbed=options.disturbed, task="stabilization", **changes)
    with options.out.open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["time", "x", "speed", "tilt", "tilt_rate", "velocity"])
        log.writerows(rows(env, Driver(np.random.default_rng(SEED)), periods))


if __name__ == "__main__":
    main()
