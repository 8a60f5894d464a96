"""Hostile requests neither make an obstacle vanish nor keep the service busy."""

from fractions import Fraction
from math import isqrt, pi
from time import thread_time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadRequest, BadShape
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, CYLINDER, FARTHEST, SPHERE, WALL, Obstacle, Shapes
from brakeline.safety.service.wire import MAX_BATCH_SIZE, MAX_REQUESTS, _count_requests, batch_of

NEAR = 1e-6  # m: what rounding may hide of a distance

coordinates = st.floats(-FARTHEST, FARTHEST)
sizes = st.floats(0.0, FARTHEST, exclude_min=True)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Obstacle, list[float]]:
    """Draw a valid obstacle and a valid position."""
    dim, kind = draw(st.sampled_from([2, 3])), draw(st.sampled_from([BOX, CYLINDER, SPHERE, WALL]))
    count = {BOX: dim, CYLINDER: dim - 1, SPHERE: 1, WALL: 0}[kind]
    obstacle = Obstacle(
        kind,
        tuple(draw(coordinates) for _ in range(dim)),
        tuple(draw(sizes) for _ in range(count)),
        draw(st.floats(-pi, pi)) if kind in (BOX, WALL) else 0.0,
    )
    return obstacle, [draw(coordinates) for _ in range(dim)]


def exact(obstacle: Obstacle, point: list[float]) -> float:
    """Return the distance in rational numbers, apart from the sines and the last root."""
    away = [Fraction(p) - Fraction(c) for p, c in zip(point, obstacle.position, strict=True)]
    cos, sin = Fraction(float(np.cos(obstacle.yaw))), Fraction(float(np.sin(obstacle.yaw)))
    along, across = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
    if obstacle.kind == WALL:
        return float(max(along, Fraction(0)))
    size = [Fraction(value) for value in obstacle.size]
    if obstacle.kind == BOX:
        outside = [abs(a) - e / 2 for a, e in zip([along, across, *away[2:]], size, strict=True)]
    elif obstacle.kind == CYLINDER:
        outside = [_root(away[0] ** 2 + away[1] ** 2) - size[0], *(abs(z) - size[1] / 2 for z in away[2:])]
    else:
        outside = [_root(sum(a**2 for a in away)) - size[0]]
    return float(_root(sum(max(value, Fraction(0)) ** 2 for value in outside)))


def _root(square: Fraction | int) -> Fraction:
    return Fraction(isqrt(int(Fraction(square) * 10**24)), 10**12)


@settings(max_examples=200)
@given(scenes())
def test_the_distance_to_an_obstacle_is_exact(scene: tuple[Obstacle, list[float]]) -> None:
    obstacle, point = scene
    distance = float(Shapes.of([obstacle], len(point)).distance(np.array(point))[0])
    assert abs(distance - exact(obstacle, point)) <= NEAR


@pytest.mark.parametrize("far", [2e4, 1e5, 1e154, 1e300, float("inf"), float("nan")])
@pytest.mark.parametrize("field", ["position", "size"])
def test_an_obstacle_out_of_bounds_is_refused(far: float, field: str) -> None:
    place = {"position": (1.0, 1.0), "size": (0.1,)} | {field: (far, 0.0) if field == "position" else (far,)}
    with pytest.raises(BadShape) as refused:
        Obstacle(SPHERE, **place)
    assert refused.value.field == field


# --- cost before work ------------------------------------------------------------------------------------------------


def refused(payload: bytes) -> tuple[str, float]:
    """Return the field in the error, and the CPU time [s] until it was raised."""
    start = thread_time()
    with pytest.raises(BadRequest) as error:
        batch_of(payload)
    return error.value.field, thread_time() - start


EMPTY = b"\x0a\x00"  # a request
ODD = b"\x10\x01\x19" + bytes(8) + b"\x25" + bytes(4)  # fields that nobody knows: a number, 8 bytes, 4 bytes


@pytest.mark.parametrize("before", [b"", ODD], ids=["plain", "odd"])
def test_half_a_million_empty_requests_are_refused_at_once(before: bytes) -> None:
    assert refused(before + EMPTY * MAX_BATCH_SIZE)[0] == "payload"
    field, seconds = refused(before + EMPTY * (MAX_BATCH_SIZE // 2 - len(before)))
    assert field == "requests" and seconds < 0.02


def test_too_many_obstacles_are_refused_before_any_decision() -> None:
    sphere = pb.Obstacle(kind="sphere", position=[1.0, 0.0], size=[0.1])
    many = pb.RequestBatch(requests=[pb.Request(robot="ground", obstacles=[sphere] * 400)] * 16)
    field, seconds = refused(many.SerializeToString())
    assert field == "obstacles" and seconds < 0.2


@given(st.binary(max_size=200))
def test_counting_requests_ends_and_raises_nothing(payload: bytes) -> None:
    assert 0 <= _count_requests(payload, MAX_REQUESTS) <= MAX_REQUESTS + 1


@given(st.integers(0, MAX_REQUESTS + 5), st.binary(max_size=20).map(lambda data: pb.Request(robot=data.hex())))
def test_requests_are_counted_as_the_decoder_does(count: int, request: pb.Request) -> None:
    payload = pb.RequestBatch(requests=[request] * count, nonce=b"one of a kind").SerializeToString()
    assert _count_requests(payload, MAX_REQUESTS) == min(count, MAX_REQUESTS + 1)
