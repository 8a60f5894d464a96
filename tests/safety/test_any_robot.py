"""Robots of every kind of description, from recorded data to a closed loop with an adversary.

The simulator judges whether the robot hits anything.
"""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from brakeline.deploy.data.environment_episodes import collect
from brakeline.messaging.obstacle import Shapes
from brakeline.safety.action_mapping import normalised
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.filter.state_limits import StateLimits
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from tests.safety.asked import cylinder
from tests.safety.toys import Toy, car, discs, hostile, near, puck, seen

LONG = (((0.15, 0.0), 0.12), ((-0.15, 0.0), 0.12))
KEEP_IN = [
    {"name": f"{sign}{axis}", "weights": {axis: 1.0 if sign == "+" else -1.0}, "most": 0.8}
    for axis in ("x", "y")
    for sign in ("+", "-")
]
SLOW = {
    "car": {"name": "slow", "weights": {"speed": 1.0}, "most": 0.35},
    "puck": {"name": "slow", "weights": {"vx": 0.6, "vy": 0.8}, "most": 0.4},
}
KINDS = {"car": partial(car, stop=([0.7, 0.2, 0.0], "hold"), body=LONG), "puck": puck}
ROBOTS = {name: kind(f"toy-{name}") for name, kind in KINDS.items()}
LIMITED = {name: kind(f"toy-{name}", limit=[*KEEP_IN, SLOW[name]]) for name, kind in KINDS.items()}
CAPSULES = {"car": (LONG[0][0], LONG[1][0], 0.12), "puck": ((0.0, 0.0), (0.0, 0.0), 0.1)}


@cache
def ready(name):
    robot = ROBOTS[name]
    env, periods, held = Toy(robot, steps=10_000), *((4500, 6) if robot.feedback else (3000, 5))
    data = collect(env, robot, periods, held=held, state=seen, actions=normalised(robot), shown=False)
    return Filter(fit_model_set(data, ModelConfig()))


def limited(name, **options):
    return Filter(replace(ready(name).model, robot=LIMITED[name]), **options)


def drive(env, filter, episodes=5, target=None):
    """Drive at the obstacles in turn, or at targets. Return the decisions' kinds and the largest distance."""
    robot, kinds, farthest = filter.robot, [], 0.0
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        aims = target or [disc.position for disc in env.unwrapped.obstacles]
        aim = aims[episode % len(aims)]
        if robot.heading is not None and target is None:  # the one ahead: the car can't turn in place
            aim = max(aims, key=lambda at: np.cos(np.arctan2(at[1], at[0]) - observation[2]))
        ended = False
        while not ended:
            action = hostile(robot, aim, observation)
            observation, _, terminated, truncated, info = env.step(action.astype(np.float32))
            ended = terminated or truncated
            if "safety" in info:
                kinds.append(info["safety"].kind)
                assert info["safety"].verified, f"{info['safety'].kind}: {info['safety'].reason}"
                assert info["safety"].contained
            farthest = max(farthest, float(np.linalg.norm(observation[:2])))
    return kinds, farthest


def filtered(env, filter):
    return SafetyWrapper(env, filter, accept_bound=1.0, state=seen, obstacles=near, actions=normalised(filter.robot))


@pytest.mark.parametrize("name", ROBOTS)
def test_an_adversary_hits_nothing_with_any_stop_rule_and_body(name):
    bare = Toy(ROBOTS[name], discs(), CAPSULES[name])
    drive(bare, ready(name), 3)
    assert bare.worst < 0.0, "without the filter, it hits"
    env = Toy(ROBOTS[name], discs(), CAPSULES[name])
    kinds, farthest = drive(filtered(env, ready(name)), ready(name))
    assert 0.0 < env.worst < 0.15, "it comes near and does not hit"
    assert farthest > 0.3
    assert {"allowed", "adjusted"} <= set(kinds)


@pytest.mark.parametrize("name", ROBOTS)
def test_limits_hold_between_periods_and_in_the_stop(name):
    robot, filter = LIMITED[name], limited(name)
    corners = [(3.0, 0.0), (3.0, 3.0), (0.0, -3.0), (-3.0, 1.0)]
    weights, most = np.array([one.weights for one in robot.limits]), np.array([one.most for one in robot.limits])
    bare = Toy(robot)
    drive(bare, filter, 4, corners)
    assert ((np.array(bare.trace) @ weights.T - most).max(0)[[0, -1]] > 0.05).all(), "without the filter it leaves"
    env = Toy(robot)
    _, farthest = drive(filtered(env, filter), filter, 4, corners)
    worst = (np.array(env.trace) @ weights.T - most).max(0)
    assert (worst <= 0.0).all()
    assert worst[-1] > -0.15, "the limit of speed is used"
    assert farthest > 0.6, "so is the room"


@pytest.mark.parametrize("name", ROBOTS)
def test_a_limit_of_the_position_holds_within_every_period_after_the_first(name):
    filter, rng = limited(name), np.random.default_rng(3)
    robot, tube = filter.robot, filter.tube
    N, d = robot.horizon, robot.position_dim
    start, turn = rng.uniform(-0.2, 0.2, d), filter.constraints.turn(0.4)
    speeds = robot.state_at_inputs(robot.high())[list(robot.regressor)]
    z = np.concatenate([speeds, np.tile(robot.high(), 1 + robot.free_steps)])
    for period in range(1, N):
        chords = tube.m_0.copy()
        chords[tube.generators + period] += 0.05  # the path of this period may bend more than the others
        bent = replace(tube, m_0=chords)
        rows = StateLimits(robot, bent).rows(start, 0.4, turn, 1.0)
        slack = (rows.bound - rows.support(bent, z)).reshape(-1, len(robot.limits))[:, : 2 * d].min(axis=0)
        for at in (period - 1, period):  # the sets at its start and at its end
            center, sizes = start + turn @ bent.centers(z)[at], bent.magnitudes(z)
            half = np.abs(turn @ bent.directions[at]) @ sizes[: tube.generators]
            beyond = half + sizes[tube.generators + period] + np.array(robot.measurement_bound[:d])
            room = 0.8 - np.array([center, -center]).T - beyond[:, None]  # to +x, -x, +y and -y
            assert (slack <= room.ravel() + 1e-9).all()


def decisions_at_the_edge(clearance_margin, count, post=False):
    """Yield decisions of the boxed car that drives near its limit in x, and optionally beside a post."""
    filter = limited("car", clearance_margin=clearance_margin)
    rng, plan, driving = np.random.default_rng(0), np.zeros((filter.robot.horizon, 2)), np.array([0.2, 0.0])
    for _ in range(count):
        state = np.array([rng.uniform(0.55, 0.8), 0.0, rng.uniform(-0.3, 0.3), 0.2])
        posts = [cylinder(state[0] + 0.1, rng.uniform(0.2, 0.4))] if post else []
        yield filter.decide(Request(state, driving, driving, plan, Shapes.of(posts, 2), known_free=not post))


@pytest.mark.parametrize("margin", [0.0, 0.05, 1.0])
def test_a_limit_is_kept_with_any_clearance_margin(margin):
    """The margin concerns obstacles, not limits."""
    kinds = set()
    for decision in decisions_at_the_edge(margin, 200):
        kinds.add(decision.kind)
        assert decision.margin >= -1e-9 or decision.kind == FAILSAFE
    assert {ALLOWED, ADJUSTED} <= kinds


def test_a_limit_never_blocks_a_proposal_that_is_adjusted_for_clearance():
    """A limit has no clearance margin, so a tube may come nearer to it than to the obstacle that is named."""
    limits, adjusted = {limit.name for limit in LIMITED["car"].limits}, 0
    for decision in decisions_at_the_edge(0.1, 300, post=True):
        if decision.for_clearance:
            assert decision.blocked_by.by not in limits
            adjusted += 1
    assert adjusted > 5


@pytest.mark.parametrize("margin", [0.2, -0.1])
def test_an_obstacles_margin_is_kept_even_if_negative(margin):
    env = Toy(ROBOTS["puck"], discs(margin), capsule=((0.0, 0.0), (0.0, 0.0), 0.1 + margin))
    drive(filtered(env, ready("puck")), ready("puck"), 5)
    assert 0.0 < env.worst < 0.12
