"""Model sets that are widened until they hold the held-out plans, and the advice on a bound that is above the limit."""

import re
from dataclasses import replace

import numpy as np
import pytest

from brakeline.deploy.commands.certify_command import CertifyCommand
from brakeline.deploy.data.certification import MAX_INFLATION, certify
from brakeline.deploy.data.coverage import coverage, recording_advice
from brakeline.errors import BadData
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.error_causes import BOTH, FAST, SLOW, STANDING, TURNING, ViolationGroup, regimes
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.model.validation import GroupStatement, most_violations, upper_bound, validate
from tests.deploy.data.porter import FILE, porter
from tests.robots import GROUND, QUADROTOR
from tests.safety.unicycle import record


@pytest.fixture(scope="module")
def data():
    """Few plans of a robot, so that its envelopes are exceeded now and then."""
    return record(trajectories=20, periods=150, seed=4)


@pytest.fixture(scope="module")
def widened(data):
    """A model set without inflation, widened until it holds every held-out plan, and its validation report."""
    return certify(data, ModelConfig(inflation=1.0), until_held=True)


@pytest.mark.parametrize("kind", ["residual", "set-membership"])
def test_it_is_as_wide_as_the_worst_of_the_held_out_plans_asks_for(data, widened, kind):
    model_config = ModelConfig(kind, inflation=1.0)
    if kind == "set-membership":
        data = replace(data, trajectories=data.trajectories[:16])
    narrow, before = certify(data, model_config)
    assert before.violations > 0 and before.excess > 1.0
    wide, after = widened if kind == "residual" else certify(data, model_config, until_held=True)
    assert after.violations == 0 and 0.9 < after.excess <= 1.0, "and no wider"
    assert wide.model_config.inflation > 1.0 and wide.version != narrow.version
    assert after.bound_plan == upper_bound(0, after.windows) < before.bound_plan
    assert after.half_width_full > before.half_width_full


def test_what_holds_already_stays_as_it_is(data):
    model_config = ModelConfig(inflation=4.0)
    assert certify(data, model_config, until_held=True)[0].version == certify(data, model_config)[0].version


def test_what_comes_later_is_outside_no_more_often_than_is_stated(data, widened):
    """Drawn like the plans that it was widened by."""
    model, statement = widened
    reports = [validate(model, data, record(trajectories=6, periods=150, seed=seed)) for seed in range(20, 26)]
    outside, plans = sum(one.violations for one in reports), sum(one.windows for one in reports)
    assert plans > 300 and outside / plans < statement.bound_plan
    assert np.isclose(max(one.excess for one in reports) > 1.0, outside > 0)


@pytest.fixture(scope="module")
def held(data):
    """A statement without a violation in some dozens of plans."""
    _, statement = certify(data, ModelConfig(), until_held=True)
    assert statement.violations == 0 and statement.bound_plan > 0.01
    return statement


def test_without_violations_more_of_the_same_will_do(held, data):
    (line,) = recording_advice(held, data)
    minutes = data.periods * GROUND.period / 60.0
    assert f"{np.ceil(minutes * (459 / held.windows - 1.0)):.0f} more minutes like these" in line
    assert "459 held-out plans without a violation" in line


def test_with_more_violations_than_the_limit_more_of_the_same_does_not_help(held, data):
    left = ViolationGroup("position ahead", FAST, 20, 200, 3.0), ViolationGroup("heading", STANDING, 13, 100, 1.2)
    bad = replace(held, windows=600, violations=33, bound_plan=upper_bound(33, 600), leaving=left)
    advice = "\n".join(recording_advice(bad, data))
    assert "at most 8.1 % of plans" in advice
    assert "33 of 600 held-out plans" in advice and "0 more minutes like these reach" not in advice
    assert "20 by position ahead while fast (of 200 such plans" in advice and "13 by heading while standing" in advice
    assert "do not help: the share of 5.5% is above the limit of 1 %" in advice
    assert "lower the bounds of speed" in advice and "record standing" in advice and "--until-held" in advice


def test_with_few_violations_more_of_the_same_helps_and_within_the_limit_nothing_is_asked_for(held, data):
    few = replace(held, windows=600, violations=3, bound_plan=upper_bound(3, 600))
    advice = "\n".join(recording_advice(few, data))
    assert few.bound_plan > 0.01 and "only if at most 0.5% of them leave" in advice
    limit = 1.01 * held.bound_plan
    assert not recording_advice(held, replace(data, robot=replace(GROUND, accept_bound=limit)))


def test_a_tube_as_wide_as_a_plan_is_long_asks_for_the_columns(held, data):
    loose = replace(data, robot=replace(GROUND, accept_bound=0.9))
    vague = replace(held, mode="one-step", half_width_full=0.2)
    (line,) = recording_advice(vague, loose)
    assert "known only to ±0.2 m" in line and "Look for a wrong column, sign or time stamp" in line
    assert "limits its acceleration" not in line
    assert not recording_advice(replace(vague, half_width_full=0.01), loose)


def test_inputs_that_jump_farther_than_the_robot_moves_ask_for_a_slew(held, data):
    """As those of a robot whose motors limit its acceleration: the jumps saturate, which no product of them shows."""
    slower = [replace(one, states=one.states * [1.0, 1.0, 1.0, 0.1, 1.0]) for one in data.trajectories]
    sluggish = replace(data, robot=replace(GROUND, accept_bound=0.9), trajectories=slower)
    (line,) = recording_advice(replace(held, mode="one-step", half_width_full=0.2), sluggish)
    assert re.search(
        r"\(the input command speed jumps by 0\.2\d? m/s in a period, the measured speed by 0\.0\d+ m/s\)", line
    )
    assert "write these changes as `slew` into the description" in line and "turn rate" not in line


def test_few_cruises_are_missing_from_the_data_of_a_policy_that_will_cruise(held, data):
    groups = tuple(
        GroupStatement(name, 9 * n, n, 0, 0.0, 1.0, 1.0, 0, 1.0)
        for name, n in (("speed at its bound", 44), ("fast", 90))
    )
    loose = replace(data, robot=replace(GROUND, accept_bound=0.9))
    (line,) = recording_advice(replace(held, mode="one-step", groups=groups), loose)
    assert line.startswith("only 0 plans with turn rate at its bound (of") and "speed at" not in line
    enough = (*groups, replace(groups[0], name="turn rate at its bound"))
    assert not recording_advice(replace(held, mode="one-step", groups=enough), loose)


def test_mode_one_step_names_the_kinds_that_left_their_sets_and_the_option_that_widens_them(held, data):
    kinds = ("start of an episode", 9, 2), (FAST, 300, 5), (STANDING, 200, 0)
    groups = tuple(GroupStatement(name, n, n, left, 0.0, 1.0, 1.3, 0, 1.0) for name, n, left in kinds)
    bad = replace(held, mode="one-step", windows=600, violations=5, bound_plan=upper_bound(5, 600), groups=groups)
    advice = "\n".join(recording_advice(bad, data))
    assert (
        "5 of 600 held-out plans (0.8%) left their sets: 5 while fast (of 300 such plans; errors up to 1.3 ×" in advice
    )
    assert "--until-held" not in advice and "smaller --outside" in advice and "lower the bounds of speed" in advice


def test_options_and_advice_of_the_linear_modes_are_not_for_mode_one_step(data, tmp_path, capsys):
    path = tmp_path / "data.safetensors"
    data.save(path)
    with pytest.raises(ValueError, match=r"--until-held is for --mode direct and recursion.*smaller --outside"):
        CertifyCommand(robot="ground", data=path, until_held=True).run()
    with pytest.raises(ValueError, match="mode one-step has no error bound matrix-zonotope: give --mode direct"):
        CertifyCommand(robot="ground", data=path, mode="one-step", certificates=("matrix-zonotope",)).run()
    assert not any("brake as the filter" in text for text in coverage(data).missing), "mode one-step uses all driving"
    first = data.trajectories[0]
    short = Trajectory(first.states[:13], first.inputs[:12], first.paths[:12], first.turned[:12])
    replace(data, trajectories=(short,)).save(path)
    assert CertifyCommand(robot="ground", data=path).run() == 1
    said = capsys.readouterr().err
    assert "one-step: refused:" in said and "--few" not in said, "more driving is missing, whatever the limits"


def test_a_data_set_in_a_file_is_certified_for_the_description_of_today(tmp_path):
    """With --data as without it: the body of today, and no data of a robot that moves otherwise."""
    file, path, text = tmp_path / "porter.toml", tmp_path / "data.safetensors", FILE.read_text()
    trajectory = Trajectory(np.zeros((3, 5)), np.zeros((2, 2)), np.zeros((2, 1, 2)), np.zeros(2))
    Dataset(porter(), (trajectory,)).save(path)
    file.write_text(text.replace("radius = 0.15", "radius = 0.4"))
    _, data, _ = CertifyCommand(robot=str(file), data=path)._load()
    assert [disc.radius for disc in data.robot.body] == [0.4]
    file.write_text(text.replace("period = 0.2", "period = 0.1"))
    with pytest.raises(BadData, match=r"the description of porter changed .*: import the log again"):
        CertifyCommand(robot=str(file), data=path)._load()


def test_how_it_drove_is_told_by_inputs_and_speeds():
    speeds = [(0.0, 0.0), (0.25, 0.0), (0.0, 0.5), (0.25, 0.5), (0.05, 0.1)]
    z = np.array([[v, w, v, w, v, w] for v, w in speeds])
    assert list(regimes(GROUND, z)) == [STANDING, FAST, TURNING, BOTH, SLOW]
    z[0, 0] = 0.2
    assert regimes(GROUND, z)[0] == FAST, "it still rolls"
    still = np.zeros((2, QUADROTOR.regressor_dim + 3))
    still[1, -1] = -5.0
    assert list(regimes(QUADROTOR, still)) == [STANDING, FAST]


def test_where_it_left_its_sets_is_found(data):
    """A robot whose wheels slip a little more, at speed, than in the data that the set was made from."""
    slipping = record(trajectories=12, periods=150, seed=9, slip=0.05)
    statement = validate(fit_model_set(data, ModelConfig()), data, slipping)
    assert statement.violations == sum(one.plans for one in statement.leaving) > 0
    most = statement.leaving[0]
    assert most.part in ("position ahead", "speed") and most.regime in (FAST, BOTH) and most.excess > 1.0
    assert most.plans <= most.of <= statement.windows


@pytest.fixture(scope="module")
def plain(data):
    """The report of a model set that nothing widens, because no number of plans states its limit."""
    return certify(replace(data, robot=replace(GROUND, accept_bound=1e-6)), ModelConfig(inflation=1.0))[1]


@pytest.mark.parametrize("limit", [0.01, 0.05, 0.3])
def test_sets_are_widened_only_as_far_as_the_limit_asks_for(data, plain, limit):
    model, statement = certify(replace(data, robot=replace(GROUND, accept_bound=limit)), ModelConfig(inflation=1.0))
    most = most_violations(statement.windows, limit)
    if most < 0 or plain.violations <= most or plain.excess > MAX_INFLATION:
        # There are too few plans for the limit, or it holds already, or it takes too much.
        assert model.model_config.inflation == 1.0
    else:
        assert model.model_config.inflation > 1.0 and statement.violations == most and statement.bound_plan <= limit


@pytest.mark.parametrize(("count", "most"), [(458, -1), (459, 0), (661, 0), (662, 1), (1283, 4)])
def test_so_many_violations_are_within_the_limit(count, most):
    assert most_violations(count, 0.01) == most
    assert upper_bound(max(most, 0), count) <= 0.01 or most < 0
    assert upper_bound(most + 1, count) > 0.01
