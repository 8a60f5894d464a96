"""Half-spaces beside movers: a mover that keeps its bounds is beyond them during every period."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.obstacle_motion import Motion, Sighting
from brakeline.safety.filter.halfspaces import half_spaces
from brakeline.safety.filter.moving_halfspaces import swept_half_spaces
from tests.messaging.test_obstacle import obstacles, sample

BODY, PERIOD, PERIODS = 0.1, 0.2, 4


def ball(rng, d, radius):
    draw = rng.normal(size=d)
    return draw * (radius * rng.choice([1.0, rng.uniform()]) / np.linalg.norm(draw))


@st.composite
def motions(draw, d):
    velocity = tuple(draw(st.floats(-1.5, 1.5)) for _ in range(d))
    bound = draw(st.floats(0, 2))
    limits = {draw(st.sampled_from(["speed", "acceleration"])): bound}
    age = draw(st.sampled_from([0.0, 0.1]))
    return Motion(velocity, draw(st.floats(0, 0.1)), draw(st.floats(0, 0.1)), **limits, age=age)


def path(motion, rng, times):
    """Return a random path (T, d) within the bounds of a motion, relative to the measured position."""
    d = len(motion.velocity)
    at = ball(rng, d, motion.position_error)
    if motion.speed is not None:
        velocity = ball(rng, d, motion.speed)
    else:
        velocity = np.array(motion.velocity) + ball(rng, d, motion.velocity_error)
    found, now, dt = [], 0.0, 0.01
    push = ball(rng, d, motion.acceleration or 0.0)
    for t in times:
        while now < t - 1e-12:
            step = min(dt, t - now)
            if rng.random() < 0.05:
                push = ball(rng, d, motion.acceleration or 0.0)
                velocity = velocity if motion.speed is None else ball(rng, d, motion.speed)
            if motion.speed is None:
                at = at + velocity * step + 0.5 * push * step * step
                velocity = velocity + push * step
            else:
                at = at + velocity * step
            now += step
        found.append(at)
    return np.array(found)


@settings(max_examples=150, deadline=None)
@given(st.data(), st.integers(0, 10_000))
def test_a_mover_within_its_bounds_stays_beyond_the_half_spaces(data, seed):
    obstacle = data.draw(obstacles())
    d = len(obstacle.position)
    motion = data.draw(motions(d))
    rng = np.random.default_rng(seed)
    start, nominal = rng.uniform(-4, 4, d), rng.uniform(-4, 4, (PERIODS, d))
    measured = rng.uniform(0, 0.05, d)
    near = MovingObstacles.of([replace(obstacle, motion=motion)], d)
    normals, offsets = swept_half_spaces(near, start, nominal, BODY, measured, PERIOD)
    solid = sample(obstacle, rng, 300)
    times = PERIOD * np.linspace(0, PERIODS, 6 * PERIODS + 1)
    for _ in range(5):
        places = path(motion, rng, motion.age + times)
        for k in range(PERIODS):
            a, b = normals[0, k], offsets[0, k]
            if b == -np.inf:
                continue
            assert np.linalg.norm(a) == pytest.approx(1.0)
            within = places[6 * k : 6 * k + 7]
            least = ((solid[:, None] + within - start) @ a).min()
            assert least >= b + BODY + np.abs(a) @ measured - 1e-7


@given(obstacles(), st.integers(0, 10_000))
def test_a_mover_with_speed_zero_leaves_no_less_room_than_a_standing_obstacle(obstacle, seed):
    rng = np.random.default_rng(seed)
    d = len(obstacle.position)
    ways = np.cumsum(rng.uniform(-0.5, 0.5, (PERIODS + 1, d)), axis=0)
    start, nominal = ways[0], ways[1:]
    near = MovingObstacles.of([replace(obstacle, motion=Motion((0.0,) * d, 0.0, speed=0.0))], d)
    normals, offsets = swept_half_spaces(near, start, nominal, BODY, np.zeros(d), PERIOD)
    still, stops = half_spaces(Shapes.of([obstacle], d), start, nominal, BODY, np.zeros(d))
    for k in range(PERIODS):
        both = (ways[k : k + 2] - start).T
        room, other = (offsets[0, k] - normals[0, k] @ both).min(), (stops[0, k] - still[0, k] @ both).min()
        if other > -BODY:  # as long as some plane keeps them apart
            assert room >= other - 1e-9


def test_the_half_spaces_recede_from_a_walker_that_comes():
    motion = Motion((-1.0, 0.0), 0.03, 0.05, acceleration=1.0)
    near = MovingObstacles.of([Obstacle("cylinder", (1.0, 0.0), (0.2,), motion=motion)], 2)
    nominal = np.array([[0.05, 0.0], [0.06, 0.0], [0.06, 0.0]])
    normals, offsets = swept_half_spaces(near, np.zeros(2), nominal, 0.1, np.zeros(2), 0.2)
    assert np.allclose(normals[0], [1.0, 0.0])
    t = 0.2 * np.arange(1, 4)
    assert np.allclose(offsets[0], 0.8 - t - (0.03 + 0.05 * t + 0.5 * t * t) - 0.1)


def test_the_memory_for_movers_grows_linearly():
    """With memory for each pair, a thousand movers in one request would block the service for seconds."""
    rng, count = np.random.default_rng(0), 1000
    motion, nominal = Motion((0.1, 0.0), 0.01, 0.01, speed=0.5), np.array([[0.05, 0.0], [0.1, 0.0], [0.1, 0.0]])
    places = rng.uniform(-2.0, 2.0, (count, 2))
    movers = MovingObstacles.of([Obstacle("cylinder", tuple(at), (0.05,), motion=motion) for at in places], 2)
    tracemalloc.start()
    normals, offsets = swept_half_spaces(movers, np.zeros(2), nominal, BODY, np.zeros(2), PERIOD)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 100 * normals.nbytes
    for i in rng.integers(0, count, 5):
        alone = swept_half_spaces(movers.take(np.array([i])), np.zeros(2), nominal, BODY, np.zeros(2), PERIOD)
        assert np.array_equal(alone[0][0], normals[i]) and np.array_equal(alone[1][0], offsets[i])


def test_a_mover_with_nan_leaves_nothing_free():
    near = MovingObstacles.of([Obstacle("sphere", (1.0, 0.0), (0.3,), motion=Motion((0.0, 0.0), 0.0, speed=1.0))], 2)
    near.drift[:] = np.nan
    _, offsets = swept_half_spaces(near, np.zeros(2), np.zeros((2, 2)), BODY, np.zeros(2), PERIOD)
    assert not (offsets > -np.inf).any()


@settings(max_examples=50, deadline=None)
@given(st.data(), st.integers(0, 10_000))
def test_a_mover_within_its_bounds_is_consistent_with_its_last_sighting(data, seed):
    """The velocity now is not drawn with the path: only the place is tested."""
    rng, motion, since = np.random.default_rng(seed), data.draw(motions(2)), 0.2
    now = path(motion, rng, [since])[0] + ball(rng, 2, motion.position_error)
    assert replace(motion, before=Sighting((0.0, 0.0), motion.velocity, since)).is_consistent(tuple(now))


def test_a_mover_that_breaks_its_bound_is_inconsistent_with_its_last_sighting():
    before = Sighting((0.0, 0.0), (1.0, 0.0), 0.2)

    def consistent(x, velocity=(1.0, 0.0)):
        return Motion(velocity, 0.01, 0.01, acceleration=1.0, before=before).is_consistent((x, 0.0))

    assert consistent(0.2) and consistent(0.24) and not consistent(0.25) and not consistent(0.15)
    assert consistent(0.2, (1.2, 0.05)) and not consistent(0.2, (1.25, 0.0))
