"""Range images, and what of space they show to be free: no point of anything in random scenes is in it."""

import copy
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadScan
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.range_image import RangeImage, directions
from brakeline.messaging.scan import BeamTracks, Scan
from brakeline.messaging.sensor_messages import image_message, image_of, measurement_in, set_measurement
from brakeline.safety.perception.displayed_map import map_for_display
from brakeline.safety.perception.image_coverage import patch_free_ranges
from tests.messaging.test_obstacle import sample
from tests.robots import QUADROTOR
from tests.safety.ray_casting import cast

RINGS, COLUMNS, FAR, WIDTH = 45, 90, 8.0, 0.6  # every 4°
EDGE = 0.5 * math.pi * (1.0 - 1.0 / RINGS)
GRID = directions(np.linspace(-EDGE, EDGE, RINGS), COLUMNS)


def hall(rng, count=5):
    """A floor, and boxes, upright cylinders and balls that are no narrower than `WIDTH`, none of them at the sensor."""
    obstacles = [Obstacle("box", (0.0, 0.0, -2.0), (40.0, 40.0, 1.0))]
    while len(obstacles) < count:
        at, kind = tuple(rng.uniform(-4.0, 4.0, 3)), rng.integers(3)
        if kind == 0:
            candidate = Obstacle("box", at, tuple(rng.uniform(WIDTH, 2.0, 3)), rng.uniform(-3.0, 3.0))
        elif kind == 1:
            candidate = Obstacle("cylinder", at, (rng.uniform(WIDTH / math.sqrt(2.0), 1.0), rng.uniform(WIDTH, 3.0)))
        else:
            candidate = Obstacle("sphere", at, (rng.uniform(0.87 * WIDTH, 1.0),))
        if Shapes.of([candidate], 3).distance(np.zeros(3))[0] > 0.3:
            obstacles.append(candidate)
    return obstacles


def taken(rng, obstacles, noise=0.0, at=(0.0, 0.0, 0.0), **more):
    """An image of these, by a sensor that is not turned."""
    ranges = cast(obstacles, np.array(at), GRID, FAR)
    noisy = np.where(ranges < FAR, np.clip(ranges + rng.uniform(-noise, noise, ranges.shape), 1e-3, FAR), FAR)
    more = {"far": FAR, "range_error": noise, "least_width": WIDTH} | more
    return RangeImage(noisy, at, low=-EDGE, high=EDGE, **more)


def solid(obstacles, rng):
    points = np.concatenate([sample(obstacle, rng, 3000) for obstacle in obstacles])
    return points[np.linalg.norm(points, axis=1) < FAR]


def free_towards(image, points):
    """F of the patches that points (n, 3) about the sensor lie in, and how far they are."""
    grid, free = patch_free_ranges(image)
    elevations = grid.elevations
    far = np.linalg.norm(points, axis=1)
    rings = np.abs(np.arcsin(points[:, 2] / far)[:, None] - elevations).argmin(axis=1)
    columns = np.rint(np.arctan2(points[:, 1], points[:, 0]) * (COLUMNS / math.tau)).astype(int) % COLUMNS
    return free[rings, columns], far


def drop(share):
    def spoil(ranges, lone, rng):
        ranges[rng.random(ranges.shape) < share] = 0.0

    return spoil


def see_through(ranges, lone, rng):
    ranges[lone] = FAR


def see_ghosts(ranges, lone, rng):
    ranges[lone] *= rng.random(int(lone.sum()))


@pytest.mark.parametrize(
    ("spoil", "noise", "doubt"),
    [
        *((drop(share), noise, 0) for share, noise in ((0.0, 0.0), (0.1, 0.0), (0.3, 0.03))),
        (see_through, 0.0, 1),
        (see_ghosts, 0.0, 0),
    ],
)
@settings(max_examples=5)
@given(st.integers(0, 100_000))
def test_nothing_is_where_it_is_said_to_be_free(spoil, noise, doubt, seed):
    """With beams that are dropped, noisy, see through obstacles, or see ghosts."""
    rng = np.random.default_rng(seed)
    obstacles = hall(rng)
    image = taken(rng, obstacles, noise, doubt=doubt)
    lone = np.zeros(image.ranges.shape, dtype=bool)
    lone[1::3, ::3] = rng.random((RINGS // 3, COLUMNS // 3)) < 0.3  # never two of a mesh
    spoil(image.ranges, lone, rng)
    free, far = free_towards(image, solid(obstacles, rng))
    assert (far >= free - 1e-9).all()


@pytest.mark.parametrize(("dropped", "least"), [(0.0, 0.6), (0.1, 0.25)])
def test_much_of_what_is_free_is_said_to_be(dropped, least):
    shares = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        obstacles = hall(rng)
        image = taken(rng, obstacles)
        image.ranges[rng.random(image.ranges.shape) < dropped] = 0.0
        shares.append(patch_free_ranges(image)[1].mean() / image.ranges.mean())
    assert np.median(shares) > least


def test_a_lone_ghost_is_none_and_a_thing_as_narrow_as_things_may_be_is_no_ghost():
    clear = RangeImage(
        np.full((RINGS, COLUMNS), FAR), (0.0, 0.0, 0.0), low=-EDGE, high=EDGE, far=FAR, least_width=WIDTH
    )
    haunted = replace(clear, ranges=clear.ranges.copy())
    haunted.ranges[20, 30] = haunted.ranges[22, 40] = 1.0
    assert patch_free_ranges(haunted)[1].min() > 1.9
    rng = np.random.default_rng(0)
    for turn in np.linspace(0.0, math.radians(4.0), 5):  # wherever the beams fall on it
        post = [Obstacle("box", (3.0 * math.cos(turn), 3.0 * math.sin(turn), 0.0), (WIDTH,) * 3, turn + 0.25 * math.pi)]
        assert patch_free_ranges(taken(rng, post))[1][RINGS // 2, :2].max() < 3.0


def test_what_is_not_seen_is_not_free():
    ranges = np.full((RINGS, COLUMNS), FAR)
    blind = RangeImage(0.0 * ranges, (0.0, 0.0, 0.0), low=-EDGE, high=EDGE)
    assert (patch_free_ranges(blind)[1] == 0.0).all()
    belt = RangeImage(ranges[:15], (0.0, 0.0, 0.0), low=-0.5, high=0.5, far=FAR)
    grid, free = patch_free_ranges(belt)
    elevations = grid.elevations
    assert (free[np.abs(elevations) > 0.5] == 0.0).all() and free[len(elevations) // 2].min() > 1.0
    assert abs(elevations[0]) <= 0.5 * math.pi and elevations[0] < -0.5 * math.pi + belt.step[0]


def test_an_image_crosses_the_wire_and_its_ranges_never_grow():
    rng = np.random.default_rng(0)
    ranges = np.where(rng.random((RINGS, COLUMNS)) < 0.1, 0.0, rng.uniform(0.2, FAR, (RINGS, COLUMNS)))
    half = math.sqrt(0.5)
    sent = RangeImage(
        *(ranges, (1.0, 2.0, 3.0), (half, 0.0, 0.0, half), -1.0, 1.2, (0.1, 0.0, 0.2), FAR, 0.03, 0.01, 0.02, 0.7),
        **{"doubt": 1, "speed": 1.6, "age": 0.2},
    )
    message = pb.Request()
    set_measurement(message, sent)
    got = measurement_in(pb.Request.FromString(message.SerializeToString()))
    assert isinstance(got, RangeImage) and message.ByteSize() < 2 * ranges.size + 200
    assert (got.ranges <= sent.ranges + 1e-6).all() and np.abs(got.ranges - sent.ranges).max() <= 0.001
    assert np.array_equal(got.valid_beams, sent.valid_beams)
    names = [field.name for field in fields(RangeImage) if field.name != "ranges"]
    assert [getattr(got, name) for name in names] == [getattr(sent, name) for name in names]
    assert np.allclose(got.rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert np.allclose(got.sensor(), [1.0, 2.1, 3.2])


def test_scans_and_images_are_equal_if_all_their_values_are():
    tracks = BeamTracks(np.zeros(4, dtype=np.uint8), np.ones((2, 4)))
    scan = Scan(np.array([1.0, 2.0, 0.0, np.nan]), np.arange(4.0), (0.0, 0.0, 0.0), tracks=tracks)
    image = RangeImage(np.full((45, 90), 20.0), (0.0, 0.0, 1.0))
    for one in (scan, image):
        same = copy.deepcopy(one)
        assert one == same and hash(one) == hash(same)
        assert one != replace(one, age=0.1) and one != replace(one, ranges=0.5 * one.ranges) and one != "scan"
    assert scan != image and scan != replace(scan, tracks=None)
    assert scan != replace(scan, tracks=replace(tracks, motions=np.zeros((2, 4))))


def test_two_at_once_and_half_a_beam_are_refused():
    message = pb.Request()
    set_measurement(message, Scan(np.ones(4), np.arange(4.0), (0.0, 0.0, 0.0)))
    assert isinstance(measurement_in(message), Scan) and measurement_in(pb.Request()) is None
    set_measurement(message, RangeImage(np.ones((RINGS, COLUMNS)), (0.0, 0.0, 0.0)))
    with pytest.raises(BadScan, match="not both"):
        measurement_in(message)
    image = message.image
    image.ranges += b"0"
    with pytest.raises(BadScan, match="two bytes"):
        image_of(image)
    image.ranges = image.ranges[:-1]
    image.ClearField("attitude")
    with pytest.raises(BadScan, match="attitude"):
        image_of(image)


def test_any_range_in_a_message_beyond_far_means_no_hit():
    message = image_message(RangeImage(np.ones((45, 90)), (0.0,) * 3, far=5.0))
    message.ranges = b"\xff" * len(message.ranges)
    assert (image_of(message).ranges == 5.0).all()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"ranges": np.ones(90)}, "rings and columns"),
        ({"ranges": np.ones((1, 90))}, "at most 12°"),
        ({"ranges": np.full((45, 90), 1200, np.uint16)}, "may be in mm"),
        ({"ranges": np.full((45, 90), 1200.0)}, "give both in m"),
        ({"doubt": 0.5}, "doubt is 0 or 1"),
        ({"ranges": np.ones((45, 12))}, "at most 12°"),
        ({"ranges": np.ones((300, 300))}, "beams at most"),
        ({"ranges": np.full((45, 90), np.nan)}, "finite"),
        ({"ranges": np.full((45, 90), -1.0)}, "0 or more"),
        ({"at": (0.0, 0.0)}, "3 coordinates"),
        ({"at": (0.0, 0.0, math.nan)}, "finite"),
        ({"attitude": (1.0, 1.0, 0.0, 0.0)}, "unit quaternion"),
        ({"low": 0.5, "high": -0.5}, "from one elevation up"),
        ({"high": 2.0}, "from one elevation up"),
        ({"range_error": -0.1}, "not negative"),
        ({"far": math.inf}, "finite"),
        ({"position_error": 1e39}, "10000 at most"),  # finite, but not in single precision
        ({"at": (1e20, 0.0, 0.0)}, "within 10000"),
        ({"least_width": 0.0}, "above 0 m"),
        ({"least_width": 600.0}, "5 m at most, not 600: give it in m"),
        ({"doubt": 2}, "doubt is 0 or 1"),
        ({"angle_error": 1.0}, "angle error"),  # degrees, say: so wide is every shadow that none would be left
        ({"low": 0.5, "high": 0.5 + 1e-6}, "so close"),
    ],
)
def test_what_is_no_image_is_refused(wrong, said):
    right = {"ranges": np.ones((45, 90)), "at": (0.0, 0.0, 0.0)}
    with pytest.raises(BadScan, match=said):
        RangeImage(**right | wrong)


def test_what_is_drawn_as_free_is_free_and_hits_lie_on_surfaces():
    rng = np.random.default_rng(3)
    obstacles = hall(rng, 7)
    message = pb.Request()
    set_measurement(message, taken(rng, obstacles))
    about, shapes = map_for_display(QUADROTOR, message, corners=60), Shapes.of(obstacles, 3)
    assert len(about.hits) > 500 and np.abs(shapes.distance(about.hits).min(axis=0)).max() < 0.01
    corners = about.free
    k, share = rng.integers(len(corners), size=2000), np.sqrt(rng.random((2000, 1)))
    edge = corners[k] + rng.random((2000, 1)) * (np.roll(corners, -1, axis=0)[k] - corners[k])
    assert shapes.distance(share * edge).min() > 0.0
    flat = about.flat(50)
    assert len(flat["hits"]) <= 50 and all(len(point) == 3 for point in (*flat["hits"], *flat["free"]))


@pytest.mark.parametrize("given", [lambda a: a.astype(np.float32), np.asfortranarray, np.ndarray.tolist])
def test_ranges_a_place_and_an_attitude_come_as_any_numbers(given):
    """As a driver or a log has them; the loops are compiled for one kind only, and compiling takes seconds."""
    image = RangeImage(given(np.ones((RINGS, COLUMNS))), np.array([1, 2, 3]), [1, 0, 0, 0], low=-EDGE, high=EDGE)
    assert (image.at, image.attitude) == ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert all(type(value) is float for value in (*image.at, *image.attitude, *image.mount))
    ranges = image.ranges
    assert ranges.dtype == np.float64 and ranges.flags.c_contiguous and (ranges == 1.0).all()
