"""Closest points and distances, against points of the shapes that are drawn independently."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadShape
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import BOX, CYLINDER, SPHERE, WALL, Obstacle, Shapes, rotate
from brakeline.messaging.obstacle_motion import Motion, Sighting

pytestmark = pytest.mark.fast

COORDINATE = st.floats(-4, 4)
SIZE = st.floats(0.05, 2)
ANGLE = st.floats(-7, 7)


@st.composite
def obstacles(draw, dim=None):
    dim = dim or draw(st.sampled_from([2, 3]))
    kind = draw(st.sampled_from([BOX, CYLINDER, SPHERE, WALL]))
    count = {BOX: dim, CYLINDER: dim - 1, SPHERE: 1, WALL: 0}[kind]
    position = tuple(draw(COORDINATE) for _ in range(dim))
    return Obstacle(kind, position, tuple(draw(SIZE) for _ in range(count)), draw(ANGLE))


def sample(obstacle, rng, count=4000):
    """Points of the solid, from what the words mean."""
    dim, kind = len(obstacle.position), obstacle.kind
    draw = rng.uniform(-1, 1, (count, dim))
    if kind == BOX:
        local = 0.5 * np.array(obstacle.size) * draw
    elif kind == WALL:
        local = 6.0 * draw
        local[:, 0] = -np.abs(local[:, 0])
    else:
        round_dim = 2 if kind == CYLINDER else dim
        ball = draw[:, :round_dim]
        ball /= np.maximum(np.linalg.norm(ball, axis=1, keepdims=True), 1.0)  # many on the surface
        local = np.zeros((count, dim))
        local[:, :round_dim] = obstacle.size[0] * ball
        if kind == CYLINDER and dim == 3:
            local[:, 2] = 0.5 * obstacle.size[1] * draw[:, 2]
    return np.array(obstacle.position) + rotate(local, obstacle.yaw)


def holds(obstacle, point, slack=1e-9):
    """Is the point in the solid? By the words again."""
    local = rotate(point - np.array(obstacle.position), -obstacle.yaw)
    if obstacle.kind == BOX:
        return (np.abs(local) <= 0.5 * np.array(obstacle.size) + slack).all()
    if obstacle.kind == WALL:
        return local[0] <= slack
    if obstacle.kind == SPHERE:
        return np.linalg.norm(local) <= obstacle.size[0] + slack
    flat = len(local) == 2 or abs(local[2]) <= 0.5 * obstacle.size[1] + slack
    return flat and np.hypot(local[0], local[1]) <= obstacle.size[0] + slack


@settings(max_examples=60)
@given(obstacles(), st.integers(0, 10_000))
def test_the_closest_point_is_in_the_shape_and_no_point_of_it_is_closer(obstacle, seed):
    rng = np.random.default_rng(seed)
    dim = len(obstacle.position)
    shapes = Shapes.of([obstacle], dim)
    points = rng.uniform(-5, 5, (5, dim))
    towards = shapes.towards(points)
    assert towards.shape == (1, 5, dim)
    drawn = sample(obstacle, rng, 2000)
    for point, vector, distance in zip(points, towards[0], shapes.distance(points)[0], strict=True):
        assert holds(obstacle, point + vector, 1e-8)
        assert distance == pytest.approx(np.linalg.norm(vector), abs=1e-9)
        assert np.linalg.norm(drawn - point, axis=1).min() >= distance - 1e-8
        if holds(obstacle, point, 0.0):
            assert distance < 1e-8
        # the closest point of a convex set: all of it is behind the plane there
        assert ((drawn - point - vector) @ vector >= -1e-7).all()


@settings(max_examples=60)
@given(obstacles(), st.integers(0, 10_000))
def test_the_way_out_ends_on_the_surface_and_none_is_shorter(obstacle, seed):
    rng = np.random.default_rng(seed)
    shapes = Shapes.of([obstacle], len(obstacle.position))
    for point in [*sample(obstacle, rng, 10), *rng.uniform(-5, 5, (10, shapes.center.shape[1]))]:
        out = shapes.to_surface(point)[0]
        depth = np.linalg.norm(out)
        if not holds(obstacle, point, -1e-7):  # outside, or as good as on the surface
            assert depth <= 1e-6
            continue
        assert holds(obstacle, point + out, 1e-9) and not holds(obstacle, point + out * (1 + 1e-6 / depth), 0.0)
        around = rng.normal(size=(50, len(point)))
        around *= depth / np.linalg.norm(around, axis=1, keepdims=True)
        assert all(holds(obstacle, point + step, 1e-9) for step in around)


def test_distances_are_those_of_each_obstacle_if_any_at_each_point():
    """`tests/safety/test_hostile.py` compares them with exact ones."""
    shapes = Shapes.of([Obstacle(SPHERE, (0, 5), (1,)), Obstacle(WALL, (0, -2), (), np.pi / 2)], 2)
    assert shapes.distance(np.array([0.0, 2.0])) == pytest.approx([2.0, 4.0])
    assert shapes.distance(np.zeros((2, 3, 2))).shape == (2, 2, 3)
    assert len(shapes.take(np.array([True, False]))) == 1
    assert Shapes.of([], 2).distance(np.zeros((4, 2))).shape == (0, 4)


NAN, INF = float("nan"), float("inf")
MALFORMED = (
    Motion(("0.5", "0"), 0.1, speed=1.0),
    Motion((0.0,), 0.0, speed=1.0),
    Motion((0.0, NAN), 0.0, speed=1.0),
    Motion((0.0, 0.0), -1.0, speed=1.0),
    Motion((0.0, 0.0), 0.0),
    Motion((0.0, 0.0), 0.0, acceleration=1.0, speed=1.0),
    Motion((0.0, 0.0), 0.0, acceleration=INF),
    Motion((0.0, 0.0), 0.0, speed=1.0, before=Sighting((0.0,), (0.0, 0.0), 0.2)),
)


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("kind", ("cone", (0, 0), (1,))),
        ("position", (SPHERE, (0,), (1,))),
        ("position", (SPHERE, (0, 0, 0), (1,))),
        ("position", (SPHERE, (0, 0, 0, 0), (1,))),
        ("position", (SPHERE, (0, NAN), (1,))),
        ("yaw", (WALL, (0, 0), (), INF)),
        ("size", (SPHERE, (0, 0), (-1,))),
        ("size", (SPHERE, (0, 0), (0,))),
        ("size", (SPHERE, (0, 0), (NAN,))),
        ("size", (BOX, (0, 0), (1,))),
        ("size", (CYLINDER, (0, 0, 0), (1,))),
        ("size", (WALL, (0, 0), (1,))),
        ("size", (CYLINDER, (0, 0), 0.1)),
        ("position", (CYLINDER, 1.0, (0.1,))),
        ("position", (CYLINDER, ("1.0", "2.0"), (0.1,))),
        ("position", (CYLINDER, "ab", (0.1,))),
        ("position", (CYLINDER, (None, 0.0), (0.1,))),
        ("position", (CYLINDER, np.zeros((2, 2)), (0.1,))),
        ("size", (CYLINDER, (0, 0), ("0.1",))),
        ("yaw", (BOX, (0, 0), (1, 1), "left")),
        ("margin", (BOX, (0, 0), (1, 1), 0.0, None)),
        ("motion", (BOX, (0, 0), (1, 1), 0.0, 0.0, (0.5, 0.0))),
        *(("motion", (BOX, (0, 0), (1, 1), 0.0, 0.0, motion)) for motion in MALFORMED),
    ],
)
def test_what_is_no_obstacle_in_the_plane_is_refused_by_its_field(field, arguments):
    with pytest.raises(BadShape) as caught:
        Shapes.of([Obstacle(*arguments)], 2)
    assert caught.value.field == field


def test_an_obstacle_stays_where_it_was_when_its_owner_overwrites_an_array():
    """A Kalman filter updates its state in place: the earlier sighting moved along, so no jump ever broke a bound."""
    tracked, size = np.array([1.0, 0.0, -0.5, 0.0]), [0.2]
    first = Obstacle(CYLINDER, tracked[:2], size, motion=Motion(tracked[2:], 0.03, acceleration=1.0))
    tracked += [0.5, 0.0, 0.1, 0.0]
    size[0] = 0.01
    assert first == Obstacle(CYLINDER, (1.0, 0.0), (0.2,), motion=Motion((-0.5, 0.0), 0.03, acceleration=1.0))
    assert len({first, first}) == 1
    before = Sighting(first.position, first.motion.velocity, since=0.2)
    second = Obstacle(CYLINDER, tracked[:2], (0.2,), motion=Motion(tracked[2:], 0.03, acceleration=1.0, before=before))
    assert not MovingObstacles.of([second], 2).consistent.any(), "it jumped by half a metre"
    kept = Sighting(tracked[:2], tracked[2:], since=0.2)
    tracked[:] = 0.0
    assert kept == Sighting((1.5, 0.0), (-0.4, 0.0), since=0.2)


def test_arrays_of_standing_obstacles_refuse_one_that_moves():
    """They left its motion out, so a request held a walker that stood."""
    walker = Obstacle(CYLINDER, (1.0, 0.0), (0.2,), motion=Motion((-0.5, 0.0), 0.03, acceleration=1.0))
    with pytest.raises(BadShape, match="split_moving"):
        Shapes.of([walker], 2)
    assert Shapes.at_present([walker], 2).distance(np.zeros(2)) == 0.8
