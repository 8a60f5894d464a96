"""The fast check of a request passes nothing that the check field by field refuses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import FARTHEST, Shapes
from brakeline.messaging.robot import robot_named
from brakeline.safety.filter.backup_plan import Prediction
from brakeline.safety.filter.request import MOST_OBSERVED, FastRequestCheck, Request, check_for_filter
from brakeline.safety.service.in_process import InProcess
from tests.safety.asked import cylinder, request, same
from tests.safety.toys import car

GROUND = robot_named("ground")
ROBOTS = GROUND, robot_named("quadrotor"), car("cart")  # the cart holds its steering
FIELDS = "state", "action", "input_in_force", "plan", "observation", "center", "half_width", "heading"
ODD = np.nan, np.inf, -np.inf, -1.0, 1e-9, 0.99e-9, 0.5, 1e30, 2.0 * FARTHEST, 1e200


def usual(robot, seed, predicted):
    rng = np.random.default_rng(seed)
    low, high = robot.low(), robot.high()
    plan = rng.uniform(low, high, (robot.horizon, robot.action_dim))
    plan[-1, robot.zero_at_rest] = 0.0
    n = robot.state_dim
    sets = Prediction(rng.normal(size=n), rng.random(n), 0.3) if predicted else None
    return Request(
        state=rng.normal(size=n),
        action=3.0 * rng.normal(size=robot.action_dim),
        input_in_force=rng.uniform(low, high),
        plan=plan,
        obstacles=Shapes.of([], robot.position_dim),
        known_free=True,
        predicted=sets,
        observation=rng.normal(size=26).astype(np.float32) if rng.random() < 0.5 else np.zeros(0, np.float32),
    )


def with_(request, field, change):
    if field not in ("center", "half_width", "heading"):
        return replace(request, **{field: change(getattr(request, field))})
    if (sets := request.predicted) is None:
        return request
    return replace(request, predicted=replace(sets, **{field: change(getattr(sets, field))}))


def lets_pass(robot, request):
    try:
        check_for_filter(robot, request)
    except BadRequest:
        return False
    return True


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
@settings(max_examples=200)
@given(st.integers(0, 1000), st.booleans(), st.sampled_from(FIELDS), st.sampled_from(ODD), st.integers(0, 50))
def test_a_request_that_passes_the_fast_check_passes_field_by_field(robot, seed, predicted, field, odd, at):
    ordinary, sound = FastRequestCheck(robot), usual(robot, seed, predicted)
    assert lets_pass(robot, sound)
    assert ordinary(sound)

    def put(values):
        if field == "heading":
            return odd
        with np.errstate(over="ignore"):
            changed = np.array(values)
            if changed.size:
                changed.ravel()[at % changed.size] = odd
        return changed

    modified = with_(sound, field, put)
    assert lets_pass(robot, modified) or not ordinary(modified)


@pytest.mark.parametrize("field", [field for field in FIELDS[:-1] if field != "observation"])
@pytest.mark.parametrize("change", [lambda v: v[:-1], lambda v: np.append(v, 0.0), lambda v: v[None]])
def test_an_array_of_another_size_fails_the_fast_check(field, change):
    sound = usual(GROUND, 1, True)
    assert FastRequestCheck(GROUND)(sound)
    assert not FastRequestCheck(GROUND)(with_(sound, field, change))


@pytest.mark.parametrize("observed", [np.zeros((1, 26)), np.zeros(MOST_OBSERVED + 1), np.float32(0.0)])
def test_the_filter_refuses_an_observation_that_is_not_a_vector_of_bounded_size(observed):
    sound = usual(GROUND, 1, True)
    for size in (0, 1, MOST_OBSERVED):
        changed = replace(sound, observation=np.zeros(size, np.float32))
        assert FastRequestCheck(GROUND)(changed) and lets_pass(GROUND, changed)
    changed = replace(sound, observation=observed)
    assert not FastRequestCheck(GROUND)(changed) and not lets_pass(GROUND, changed)


def test_the_type_and_layout_of_arrays_do_not_change_the_decision(ready):
    sound = request(action=(0.25, 0.5), obstacles=[cylinder(1.0, 0.0)])
    expected = ready.decide(sound)
    stridden = {name: np.repeat(getattr(sound, name), 2, axis=0)[::2] for name in ("state", "action", "input_in_force")}
    single = {name: value.astype(np.float32) for name, value in stridden.items()}
    # as NumPy sees an array of JAX, or a message's bytes
    fixed = {name: np.frombuffer(value.tobytes()) for name, value in stridden.items()}
    for odd in (stridden, single, fixed):
        assert same(ready.decide(replace(sound, **odd)), expected)
    assert same(ready.decide(replace(sound, plan=sound.plan.astype(int))), expected)
    assert InProcess(ready, 1.0).decide(fixed["state"], fixed["action"], known_free=True).verified
    rest, whole = ready.standing_reservation(np.zeros(5)), ready.standing_reservation(np.zeros(5, np.float32))
    assert np.array_equal(rest.center, whole.center) and np.array_equal(rest.half_width, whole.half_width)


ARRAYS = {
    "a radius missing": {"rho": np.full(1, 0.1)},
    "no radii": {"rho": np.zeros(0)},
    "axes in space": {"axes": np.tile(np.eye(3), (2, 1, 1))},
    "single precision": {"half": np.zeros((2, 2), np.float32)},
    "flags": {"round": np.ones((2, 2), dtype=bool)},
    "one margin": {"margin": np.zeros(1)},
    "read-only": {"axes": np.broadcast_to(np.eye(2), (2, 2, 2))},
}


@pytest.mark.parametrize("changed", ARRAYS.values(), ids=ARRAYS)
def test_obstacles_whose_arrays_do_not_fit_are_refused(ready, changed):
    """With a radius missing, the last obstacle did not count; compiled code read past the end of other short arrays."""
    two = Shapes.of([cylinder(3.0, 0.0), cylinder(0.3, 0.0)], 2)
    with pytest.raises(BadRequest, match=r"obstacles\..* need .* float64, writable: use Shapes\.of") as caught:
        ready.decide(request(obstacles=replace(two, **changed)))
    assert caught.value.field == "obstacles"


def test_known_free_must_be_a_truth_value(ready):
    with pytest.raises(BadRequest, match="known_free is a str: give True or False") as caught:
        ready.decide(request(known_free="no"))
    assert caught.value.field == "known_free"


def test_a_position_on_the_globe_is_refused_with_what_to_do(ready):
    """Coordinates of a map projection, such as UTM, leave no digits for millimetres."""
    with pytest.raises(
        BadRequest, match=r"a state beyond ±10000 .* y \[m\] is 5\.33e\+06; .* an origin near the robot"
    ):
        ready.decide(request(state=(691_000.0, 5_330_000.0, 0.0, 0.0, 0.0)))
