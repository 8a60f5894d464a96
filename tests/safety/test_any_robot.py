"""Robots of every kind of description, from data collected through their environment to a closed loop with an
adversary; whether anything was hit is the simulator's word."""

import numpy as np
import pytest

from brakeline.deploy.data.environment_episodes import collect
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.action_mapping import normalised
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from tests.safety.toys import Toy, car, discs, hostile, near, puck, seen

LONG = (((0.15, 0.0), 0.12), ((-0.15, 0.0), 0.12))
KEEP_IN = [
    {"name": f"{sign}{axis}", "weights": {axis: 1.0 if sign == "+" else -1.0}, "most": 0.8}
    for axis in ("x", "y")
    for sign in ("+", "-")
]
ROBOTS = {
    "hold": car("toy-hold"),
    "profile": car("toy-profile", stop=([0.7, 0.2, 0.0], "ramp")),
    "discs": car("toy-discs", body=LONG),
    "feedback": puck("toy-feedback"),
    "boxed car": car("toy-boxed", limit=[*KEEP_IN, {"name": "slow", "weights": {"speed": 1.0}, "most": 0.35}]),
    "boxed puck": puck(
        "toy-boxed-puck", limit=[*KEEP_IN, {"name": "slow", "weights": {"vx": 0.6, "vy": 0.8}, "most": 0.4}]
    ),
}
_made = {}


def ready(name):
    if name not in _made:
        robot = ROBOTS[name]
        periods, held = (9000, 6) if robot.feedback else (6000, 5)
        env = Toy(robot, steps=10_000)
        data = collect(env, robot, periods, held=held, state=seen, actions=normalised(robot), shown=False)
        _made[name] = Filter(fit_model_set(data, ModelConfig()))
    return _made[name]


def drive(env, filter, episodes=8, target=None):
    """An adversary at the obstacles in turn (or at targets); returns the kinds of decisions and the farthest way."""
    robot, kinds, farthest = filter.robot, [], 0.0
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        aims = target or [disc.position for disc in env.unwrapped.obstacles]
        aim = aims[episode % len(aims)]
        if robot.heading is not None and target is None:  # the one ahead: it can't turn on the spot
            aim = max(aims, key=lambda at: np.cos(np.arctan2(at[1], at[0]) - observation[2]))
        ended = False
        while not ended:
            action = hostile(robot, aim, observation)
            observation, _, terminated, truncated, info = env.step(action.astype(np.float32))
            ended = terminated or truncated
            if "safety" in info:
                kinds.append(info["diagnostics"]["kind"])
                assert info["safety"].verified, f"{name_of(info)}"
                assert info["safety"].contained
            farthest = max(farthest, float(np.linalg.norm(observation[:2])))
    return kinds, farthest


def name_of(info):
    return f"{info['safety'].kind}: {info['safety'].reason}"


def filtered(env, filter):
    return SafetyWrapper(env, filter, accept_bound=1.0, state=seen, obstacles=near, actions=normalised(filter.robot))


@pytest.mark.parametrize("name", ["hold", "profile", "discs", "feedback"])
def test_no_stop_rule_and_no_body_lets_an_adversary_hit_anything(name):
    capsule = (LONG[0][0], LONG[1][0], 0.12) if name == "discs" else ((0.0, 0.0), (0.0, 0.0), 0.1)
    bare = Toy(ROBOTS[name], discs(), capsule)
    drive(bare, ready(name), 3)
    assert bare.worst < 0.0, "without the filter it hits"
    env = Toy(ROBOTS[name], discs(), capsule)
    kinds, farthest = drive(filtered(env, ready(name)), ready(name))
    assert 0.0 < env.worst < 0.15, "it comes near, and no nearer"
    assert farthest > 0.3
    assert {"allowed", "adjusted"} <= set(kinds)


@pytest.mark.parametrize("name", ["boxed car", "boxed puck"])
def test_limits_hold_between_periods_and_in_the_stop(name):
    robot = ROBOTS[name]
    corners = [(3.0, 0.0), (3.0, 3.0), (0.0, -3.0), (-3.0, 1.0)]
    weights, most = np.array([one.weights for one in robot.limits]), np.array([one.most for one in robot.limits])
    bare = Toy(robot)
    drive(bare, ready(name), 4, corners)
    assert ((np.array(bare.trace) @ weights.T - most).max(0)[[0, -1]] > 0.05).all(), "without the filter it leaves"
    env = Toy(robot)
    _, farthest = drive(filtered(env, ready(name)), ready(name), 4, corners)
    worst = (np.array(env.trace) @ weights.T - most).max(0)
    assert (worst <= 0.0).all()
    assert worst[-1] > -0.15, "the limit of speed is used"
    assert farthest > 0.6, "so is the room"


def test_a_limit_is_kept_whatever_the_clearance_margin():
    """Less than none leaves it to obstacles what is kept to them, and says nothing of limits."""
    ours = Filter(ready("boxed car").model, clearance_margin=-0.05)
    rng, plan, kinds = np.random.default_rng(0), np.zeros((ours.robot.horizon, 2)), set()
    for _ in range(200):
        state = np.array([rng.uniform(0.55, 0.8), 0.0, rng.uniform(-0.3, 0.3), 0.2])
        driving = np.array([0.2, 0.0])
        decision = ours.decide(Request(state, driving, driving, plan, Shapes.of([], 2), known_free=True))
        kinds.add(decision.kind)
        assert decision.margin >= -1e-9 or decision.kind == FAILSAFE
    assert {ALLOWED, ADJUSTED} <= kinds


def test_what_is_replaced_for_clearance_is_not_laid_to_a_limit():
    """A limit has no clearance margin, so a tube may come nearer to it than to the obstacle that is named."""
    ours = Filter(ready("boxed car").model, clearance_margin=0.1)
    limits = {limit.name for limit in ours.robot.limits}
    rng, plan, near = np.random.default_rng(0), np.zeros((ours.robot.horizon, 2)), 0
    for _ in range(300):
        state = np.array([rng.uniform(0.55, 0.8), 0.0, rng.uniform(-0.3, 0.3), 0.2])
        driving = np.array([0.2, 0.0])
        about = Shapes.of([Obstacle("cylinder", (state[0] + 0.1, rng.uniform(0.2, 0.4)), (0.1,))], 2)
        decision = ours.decide(Request(state, driving, driving, plan, about))
        if decision.for_clearance:
            assert decision.blocked_by.by not in limits
            near += 1
    assert near > 5


@pytest.mark.parametrize("margin", [0.2, -0.1])
def test_a_margin_is_kept_or_spared(margin):
    robot = ROBOTS["feedback"]
    env = Toy(robot, discs(margin), capsule=((0.0, 0.0), (0.0, 0.0), 0.1 + margin))
    drive(filtered(env, ready("feedback")), ready("feedback"), 5)
    assert 0.0 < env.worst < 0.12
