"""Validation of a model set on held-out data."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest

from brakeline.safety.model.error_bounds import KINDS
from brakeline.safety.model.model_set import MODES
from brakeline.safety.model.validation import upper_bound, validate
from brakeline.safety.model.windows import windows
from tests.safety.unicycle import record

ALL = [(kind, mode) for kind in KINDS for mode in MODES]


def test_known_values_of_the_bound():
    assert upper_bound(0, 100) == pytest.approx(1 - 0.01 ** (1 / 100))
    assert upper_bound(0, 1) == pytest.approx(0.99)
    assert upper_bound(5, 5) == upper_bound(0, 0) == 1.0
    for violations, count in ((1, 10), (3, 50), (20, 1000)):  # so few would be seen in 1 % of all cases
        p = upper_bound(violations, count)
        assert sum(comb(count, i) * p**i * (1 - p) ** (count - i) for i in range(violations + 1)) == pytest.approx(0.01)


@pytest.mark.parametrize("which", ALL, ids="-".join)
def test_a_model_set_holds_on_data_it_has_not_seen(models, data, held_out, which):
    report = validate(models[which], data, held_out)
    assert (report.certificate, report.mode) == which
    assert report.version == models[which].version
    assert report.windows > 500
    assert report.violations <= 0.01 * report.windows
    assert report.step_violations <= report.violations
    assert report.bound_step <= report.bound_plan < 0.05
    assert report.bound_step <= report.bound_episode <= 1.0
    assert report.outside_episode == pytest.approx(300 * report.bound_step)
    assert report.outside_episode > report.bound_episode
    assert report.outside_hour == pytest.approx(18_000 * report.bound_step), "a period lasts 0.2 s"
    assert 0 < report.half_width_rest < report.half_width_full
    assert report.samples == len(windows(data, 3))
    assert set(report.figures()) > {"samples", "rank", "condition", "bound_step", "bound_plan"}


def test_a_narrowed_model_shows_its_violations(model, data, held_out):
    honest = validate(model, data, held_out)
    narrow = replace(model, steps=tuple(replace(s, kappa=0.5 * s.kappa, w=0.5 * s.w) for s in model.steps))
    report = validate(narrow, data, held_out)
    assert report.violations > 0.2 * report.windows
    assert report.bound_plan > 20 * honest.bound_plan
    for part in ("chord_deviations", "stopping_distance"):
        thin = getattr(model, part)
        gone = replace(model, **{part: replace(thin, kappa=0.0 * thin.kappa, w=0.0 * thin.w)})
        assert validate(gone, data, held_out).violations > 0.2 * honest.windows


def test_a_robot_that_changed_is_noticed(model, data):
    slipping = record(trajectories=10, periods=300, seed=3, slip=0.3)
    assert validate(model, data, slipping).violations > 100


def test_only_stops_that_were_seen_count(model, data, held_out):
    cut = replace(held_out, trajectories=tuple(replace(t) for t in held_out.trajectories[:5]))
    whole = windows(cut, 3)
    assert validate(model, data, cut).windows <= (~np.isnan(whole.stopping_distance)).sum()
