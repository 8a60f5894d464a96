"""Model sets from data without plans: their tubes hold for plans too."""

import itertools

import numpy as np
import pytest

from brakeline.deploy.data.excitation import excitation
from brakeline.errors import BadData
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_config import KINDS, RESIDUAL, ModelConfig
from brakeline.safety.model.validation import validate
from brakeline.safety.model.windows import FREE, PLAN, plan_regressor_map, windows

ROBOT = robot_from_description(
    {
        "name": "lagging-puck",
        "period": 0.2,
        "sight": 3.0,
        "state": {
            "x": {"unit": "m", "role": "position", "error": 0.002},
            "y": {"unit": "m", "role": "position", "error": 0.002},
            "vx": {"unit": "m/s", "error": 0.01, "follows": "ux"},
            "vy": {"unit": "m/s", "error": 0.01, "follows": "uy"},
        },
        "input": {"ux": {"unit": "m/s", "low": -1, "high": 1}, "uy": {"unit": "m/s", "low": -0.5, "high": 0.5}},
        "plan": {"horizon": 3, "brake": 2},
        "body": [{"at": [0.0, 0.0], "radius": 0.1}],
    }
)
ALL = [*((kind, "direct") for kind in KINDS), (RESIDUAL, "recursion")]
KEEP = np.exp(-0.2 / 0.15)  # of a speed, after a period


def moved(x, u):
    """Return the state after one period of a linear robot, and the position half-way."""
    half = np.exp(-0.1 / 0.15)
    way = [u * t + 0.15 * (x[2:] - u) * (1.0 - keep) for t, keep in ((0.1, half), (0.2, KEEP))]
    return np.concatenate([x[:2] + way[1], u + KEEP * (x[2:] - u)]), x[:2] + way[0]


def driven(inputs, rng, noise):
    x, states, paths = np.zeros(4), [], []
    bound = noise * np.array([0.001, 0.001, 0.004, 0.004])
    states.append(x + rng.uniform(-bound, bound))
    for u in inputs:
        after, half = moved(x, u)
        paths.append([half - x[:2], after[:2] - x[:2]])
        x = after
        states.append(x + rng.uniform(-bound, bound))
    return Trajectory(np.array(states), np.array(inputs), np.array(paths), np.zeros(len(inputs)), np.zeros(2))


def wandering(rng, count):
    """Yield inputs that follow no plan, with some stops."""
    while count > 0:
        for _ in range(rng.integers(4, 12)):
            yield rng.uniform(ROBOT.low(), ROBOT.high())
        for _ in range(rng.integers(3, 8)):
            yield np.zeros(2)
        count -= 1


def free_data(seed, noise=1.0, count=20):
    rngs = [np.random.default_rng((seed, i)) for i in range(count)]
    return Dataset(ROBOT, tuple(driven(list(wandering(rng, 6)), rng, noise) for rng in rngs))


def test_a_plans_regressors_map_to_those_of_a_free_window():
    rngs = [np.random.default_rng((0, i)) for i in range(20)]
    inputs = [list(itertools.islice(excitation(ROBOT, rng), 80)) for rng in rngs]
    planned = Dataset(ROBOT, tuple(driven(*parts, noise=0.0) for parts in zip(inputs, rngs, strict=True)))
    plans, free = windows(planned, ROBOT.horizon, PLAN), windows(planned, ROBOT.horizon, FREE)
    place = {tuple(start): i for i, start in enumerate(free.start)}
    rows = [place[tuple(start)] for start in plans.start]
    assert len(plans) > 200 and len(free) > 2 * len(plans)
    assert np.allclose(plans.z @ plan_regressor_map(ROBOT).T, free.z[rows], rtol=0.0, atol=1e-12)
    assert np.array_equal(plans.y, free.y[rows])


@pytest.mark.parametrize("which", ALL, ids="-".join)
def test_tubes_from_free_driving_hold_plans_that_were_never_driven(which):
    tube, S = fit_model_set(free_data(3), ModelConfig(*which, windows=FREE)).tube(), ROBOT.plan_matrix()
    rng, outside = np.random.default_rng(4), 0
    for _ in range(300):
        before, chosen = rng.uniform(ROBOT.low(), ROBOT.high(), (2, 2))
        x, _ = moved(np.concatenate([np.zeros(2), rng.uniform(-1, 1, 2) / 2]), before)
        x[:2] = 0.0
        z = np.concatenate([x[2:] + rng.uniform(-0.004, 0.004, 2), before, chosen])
        centers, half = tube.centers(z), tube.half_widths(z)
        for k, u in enumerate((S @ chosen).reshape(-1, 2)):
            x, _ = moved(x, u)
            outside += (np.abs(x[:2] - centers[k]) > half[k] + 0.002).any()
    assert outside <= 4, f"{outside} of 900 positions"


def test_the_validation_report_is_about_windows_of_the_same_kind():
    fitted = free_data(5)
    model = fit_model_set(fitted, ModelConfig(windows=FREE))
    report = validate(model, fitted, free_data(6, count=40))
    assert report.windows > 300 and report.bound_step < 0.05 and report.bound_plan < 0.1
    worse = validate(model, fitted, free_data(6, noise=10.0))
    assert worse.step_violations > 0.3 * worse.windows


def test_an_error_about_missing_stops_says_what_to_drive():
    rng = np.random.default_rng(7)
    inputs = [driven(list(rng.uniform(ROBOT.low(), ROBOT.high(), (60, 2))), rng, 1.0) for _ in range(30)]
    with pytest.raises(BadData, match=r"0 stops in the data.*from every speed give zero input and let the robot stand"):
        fit_model_set(Dataset(ROBOT, tuple(inputs)), ModelConfig(windows=FREE))
