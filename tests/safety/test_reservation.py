"""Reservations contain the tube that they come from, and half-spaces keep off them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.safety.filter.reservation import OtherReservations, Reservation, reservation_half_spaces

FINITE = st.floats(-1.0, 1.0)
N = 3


def drawn(rng, middle=0.0, size=0.05):
    centers = middle + np.cumsum(rng.normal(scale=0.05, size=(N + 1, 2)), axis=0)
    return centers, size * rng.random((N + 1, 2)), 0.1 + 0.05 * rng.random(N)


@given(st.integers(0, 10**6))
def test_a_reservation_contains_every_path_between_its_sets(seed):
    rng = np.random.default_rng(seed)
    centers, half, radius = drawn(rng)
    reservation = Reservation.of(centers, half, radius)
    points = centers + half * rng.uniform(-1, 1, (N + 1, 2))
    for k in range(N):
        between = points[k] + rng.random((20, 1)) * (points[k + 1] - points[k])
        assert (np.abs(between - reservation.center[k]) <= reservation.half_width[k] + 1e-12).all()


def test_each_period_removes_the_first_box_and_keeps_the_last():
    rng = np.random.default_rng(0)
    reservation = Reservation.of(*drawn(rng))
    later = reservation.later()
    assert np.array_equal(later.center[:-1], reservation.center[1:])
    assert np.array_equal(later.center[-1], reservation.center[-1])
    for _ in range(5):
        later = later.later()
    assert (later.center == reservation.center[-1]).all() and (later.half_width == reservation.half_width[-1]).all()


def test_a_measured_position_may_be_outside_of_the_box_by_its_error_and_the_last_millimetres():
    box = Reservation(np.zeros((N, 2)), np.tile([0.1, 0.2], (N, 1)), np.full(N, 0.105 + 0.003))
    places = ((0.11, 0.0), True), ((0.112, 0.21), True), ((0.114, 0.0), False), ((0.113, 0.213), False)
    for position, inside in places:
        assert box.may_contain(np.array(position), (0.01, 0.01), 0.105) == inside
        assert box.may_contain(-np.array(position), (0.01, 0.01), 0.105) == inside


@settings(max_examples=200)
@given(st.integers(0, 10**6))
def test_points_in_a_periods_half_space_keep_off_the_reservation_of_that_period(seed):
    rng = np.random.default_rng(seed)
    others = [Reservation.of(*drawn(rng, middle=rng.uniform(-0.6, 0.6, 2))) for _ in range(3)]
    start, nominal = np.zeros(2), np.cumsum(rng.normal(scale=0.06, size=(N, 2)), axis=0)
    measured = 0.01 * rng.random(2)
    normals, offsets = reservation_half_spaces(OtherReservations.to(others), start, nominal, 0.105, measured)
    for normal, offset, other in zip(normals, offsets, others, strict=True):
        for k in range(N):
            points = rng.uniform(-1, 1, (400, 2))
            points = points[points @ normal[k] <= offset[k]] + measured * rng.uniform(-1, 1, 2)
            away = np.maximum(np.abs(points - other.center[k]) - other.half_width[k], 0.0)
            assert (np.linalg.norm(away, axis=1) >= 0.105 + other.radius[k] - 1e-9).all()


def test_a_reservation_that_passes_by_leaves_room_behind_it():
    """Each box counts in its own period only."""
    centers = np.array([[0.35, 0.0], [0.35, 0.6], [0.35, 1.2], [0.35, 1.8]])
    gone = Reservation.of(centers, np.full((4, 2), 0.01), np.full(3, 0.1))
    nominal = np.array([[0.05, 0.0], [0.1, 0.0], [0.15, 0.0]])
    normals, offsets = reservation_half_spaces(OtherReservations.to([gone]), np.zeros(2), nominal, 0.105, np.zeros(2))
    room = offsets[0] - np.einsum("kd,kd->k", normals[0], nominal)
    assert room[0] < 0.2 and room[2] > 0.8


def test_the_distances_of_reservations():
    def at(x, half_width=0.0):
        return Reservation.of(np.full((4, 2), [x, 0.0]), np.full((4, 2), half_width), np.full(3, 0.1))

    for away in (0.2, 0.5, 2.0):
        other = at(away + 0.1)
        assert (OtherReservations.to([other]).nearest(np.zeros(2))[0] < 1.0) == (away < 1.0)
    assert OtherReservations.to([]) is None
    touched = OtherReservations.to([at(0.0, 0.05)])
    _, offsets = reservation_half_spaces(touched, np.zeros(2), np.zeros((3, 2)), 0.105, np.zeros(2))
    assert (offsets == -np.inf).all(), "it leaves no room"
