"""Limits of the heading, for a robot that turns on and on and measures its heading up to whole turns."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from brakeline.deploy.data.environment_episodes import collect
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.action_mapping import normalised
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ALLOWED, Request
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from tests.safety.toys import Toy, car, seen

FAR_AWAY = [Obstacle("cylinder", (50.0, 50.0), (0.1,))]


def limited(low, high):
    sides = (("left", 1.0, high), ("right", -1.0, -low))
    return car("toy", limit=[{"name": n, "weights": {"heading": weight}, "most": most} for n, weight, most in sides])


@cache
def model():
    robot = limited(-1.0, 1.0)
    data = collect(Toy(robot, steps=10_000), robot, 3000, held=5, state=seen, actions=normalised(robot), shown=False)
    return fit_model_set(data, ModelConfig())


class Begun(Toy):
    """A toy that begins with a given heading."""

    def __init__(self, robot, heading):
        super().__init__(robot, steps=150)
        self.heading = heading

    def reset(self, **more):
        super().reset(**more)
        self.state[2] = self.heading
        return self.state.copy(), {}


@pytest.mark.parametrize("turns", [-1, 0, 2])
@pytest.mark.parametrize(("low", "high"), [(-3.0, 3.0), (2.5, 3.7), (-4.0, -2.3), (9.0, 9.9)])
def test_a_limit_beyond_pi_holds_for_a_heading_that_is_measured_up_to_whole_turns(low, high, turns):
    """With a limit of 3.3 rad, all turns were verified: a heading of 3.4 rad was measured as -2.88 rad."""

    def measured(env, observation, info):
        state = np.array(observation)
        state[2] = (state[2] + math.pi) % math.tau - math.pi + math.tau * turns
        return state

    robot = limited(low, high)
    for side in (-1.0, 1.0):
        env = Begun(robot, 0.5 * (low + high))
        filtered = SafetyWrapper(
            env,
            Filter(replace(model(), robot=robot)),
            accept_bound=1.0,
            state=measured,
            obstacles=lambda *_: FAR_AWAY,
            actions=normalised(robot),
        )
        filtered.reset(seed=0)
        headings, verified = [], True
        for _ in range(100):
            observation, *_, info = filtered.step(np.array([1.0, side], np.float32))
            headings.append(observation[2])
            verified &= info["safety"].verified
        assert verified and low < min(headings) and max(headings) < high
        reached = max(headings) > high - 0.1 if side > 0.0 else min(headings) < low + 0.1
        assert reached, "the robot turns up to its limit"


@pytest.mark.parametrize("loose_first", [False, True])
@pytest.mark.parametrize("strict", [-1.0, 1.0])
def test_a_looser_limit_beside_a_strict_one_allows_no_heading_that_the_strict_one_forbids(strict, loose_first):
    """With θ ≤ 1, θ ≤ 3 and -θ ≤ 2.9, a heading of 2.5 rad was verified: it met the strict limit after a turn."""
    mosts = [("loose", strict, 3.0), ("strict", strict, 1.0)][:: 1 if loose_first else -1]
    sides = [*mosts, ("other side", -strict, 2.9)]
    robot = car("toy", limit=[{"name": n, "weights": {"heading": w}, "most": most} for n, w, most in sides])
    safety = Filter(replace(model(), robot=robot))

    def allows(heading):
        state, stop, free = [0.0, 0.0, strict * heading, 0.0], np.zeros((6, 2)), Shapes.of([], dim=2)
        return safety.decide(Request(state, stop[0], stop[0], stop, free, known_free=True)).kind == ALLOWED

    allowed = [heading for heading in np.arange(-2.8, 3.2, 0.1) if allows(heading)]
    assert len(allowed) > 30 and max(allowed) < 1.0
