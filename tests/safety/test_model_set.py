"""Model sets: they hold on held-out data, a version names one content, and malformed files are refused."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brakeline.errors import BadData, BadModel, BadTensors, ErrorBoundError
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.error_bounds import least_squares
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_config import DIRECT, KINDS, MODES, ModelConfig
from brakeline.safety.model.model_set import ENTRY, ModelSet
from brakeline.safety.model.tensor_file import content, has_entry, pack, unpack
from brakeline.safety.model.validation import upper_bound, validate
from brakeline.safety.model.windows import periods_until_standing, windows
from tests.robots import GROUND
from tests.safety.unicycle import Unicycle, record

ALL = [(kind, mode) for kind in KINDS for mode in MODES]


@pytest.fixture(scope="module")
def plans(data):
    return windows(data, 3)


@pytest.fixture(scope="module")
def held_out_plans(held_out):
    return windows(held_out, 3)


@pytest.mark.parametrize("which", ALL, ids="-".join)
def test_a_model_set_is_decoded_unchanged_and_holds_on_its_own_and_on_fresh_data(
    models, data, plans, held_out, held_out_plans, which
):
    model = models[which]
    again = ModelSet.decode(model.encode())
    assert (again.version, again.model_config, again.about) == (model.version, model.model_config, model.about)
    z = np.array([0.1, 0.2, 0.1, 0.2, 0.25, -0.5])
    for one, other in ((model.tube(), again.tube()), (model.outer_tube(), again.outer_tube())):
        assert np.array_equal(one.magnitudes(z), other.magnitudes(z))
        assert np.array_equal(one.centers(z), other.centers(z))

    _, bound = data.split((0.5, 0.5))
    w = windows(bound, 1)
    z = model.first_regressor(w.z)
    assert (np.abs(w.y - z @ model.first.C.T) <= model.first.half_widths(z) + 1e-12).all()
    assert (w.chord_deviation <= model.chord_deviations.half_widths(w.z)[:, 0]).all()
    seen = ~np.isnan(plans.stopping_distance)
    assert (plans.stopping_distance[seen] <= model.stopping_distance.half_widths(plans.z[seen])[:, 0]).all()

    report = validate(model, data, held_out)
    assert (report.certificate, report.mode, report.version) == (*which, model.version)
    assert 500 < report.windows <= (~np.isnan(held_out_plans.stopping_distance)).sum(), "only stops that were seen"
    assert report.violations <= 0.01 * report.windows
    assert report.step_violations <= report.violations
    assert report.bound_step <= report.bound_plan < 0.05
    assert report.bound_step <= report.bound_episode <= 1.0
    assert report.outside_episode == pytest.approx(300 * report.bound_step)
    assert report.outside_episode > report.bound_episode
    assert report.outside_hour == pytest.approx(18_000 * report.bound_step), "a period lasts 0.2 s"
    assert 0 < report.half_width_rest < report.half_width_full
    assert report.samples == len(plans)
    assert set(report.figures()) > {"samples", "rank", "condition", "bound_step", "bound_plan"}
    if report.mode == DIRECT:
        assert report.in_place_windows > 100 and report.in_place_violations <= 0.02 * report.in_place_windows


def test_known_values_of_the_bound():
    assert upper_bound(0, 100) == pytest.approx(1 - 0.01 ** (1 / 100))
    assert upper_bound(0, 1) == pytest.approx(0.99)
    assert upper_bound(5, 5) == upper_bound(0, 0) == 1.0
    for violations, count in ((1, 10), (3, 50), (20, 1000)):  # so few would be seen in 1 % of all cases
        p = upper_bound(violations, count)
        assert sum(comb(count, i) * p**i * (1 - p) ** (count - i) for i in range(violations + 1)) == pytest.approx(0.01)


def test_a_narrowed_model_and_a_robot_that_changed_show_their_violations(model, data, held_out):
    honest = validate(model, data, held_out)
    narrow = replace(model, steps=tuple(replace(s, kappa=0.5 * s.kappa, w=0.5 * s.w) for s in model.steps))
    report = validate(narrow, data, held_out)
    assert report.violations > 0.2 * report.windows
    assert report.bound_plan > 20 * honest.bound_plan
    for part in ("chord_deviations", "stopping_distance"):
        thin = getattr(model, part)
        gone = replace(model, **{part: replace(thin, kappa=0.0 * thin.kappa, w=0.0 * thin.w)})
        assert validate(gone, data, held_out).violations > 0.2 * honest.windows
    assert validate(model, data, record(trajectories=10, periods=300, seed=3, slip=0.3)).violations > 100


def test_the_version_names_the_content(models, model, data):
    assert len({models[which].version for which in ALL}) == len(ALL)
    assert fit_model_set(data, ModelConfig()).version == model.version
    wider = replace(model, stopping_distance=replace(model.stopping_distance, w=model.stopping_distance.w + 1e-6))
    assert wider.version != model.version
    assert replace(model, about={"note": "another"}).version == model.version
    assert replace(model, model_config=replace(model.model_config, mode="recursion")).version != model.version


def test_a_robot_without_a_measured_speed_stands_once_its_pose_stays():
    """Its log has a gyro and poses. It brakes straight ahead, so the gyro shows no motion."""
    robot = replace(GROUND, regressor=(4,), stop=((0.5, 0.0), "ramp"))
    plan = np.array([[0.25, 0.0], [0.125, 0.0], [0.0, 0.0]])
    drives = [Unicycle((0.0, 0.0, a), np.random.default_rng(a), noise=0.0).trajectory([*plan] * 5) for a in range(8)]
    data = Dataset(robot, tuple(drives))
    assert periods_until_standing(windows(data, robot.horizon), data, "plan") == 2


def test_the_time_until_a_robot_stands_comes_from_the_data(model, data, plans):
    """The robot stands after two of three periods, unless one recorded plan still moved then."""
    assert model.moving == model.stands == 2
    number, start = plans.start[len(plans) // 2]
    some = list(data.trajectories)
    some[number] = replace(some[number], states=some[number].states.copy())
    some[number].states[start + 2, 3] = 0.03  # it coasts
    assert periods_until_standing(plans, replace(data, trajectories=some), "plan") == 3
    assert periods_until_standing(plans, data, "plan") == 2 and periods_until_standing(plans, data, "free") == 3
    assert ModelSet.decode(model.encode()).stands == 2
    assert replace(model, stands=3).version != model.version
    assert replace(model, stands=3).version == replace(model, stands=0).version  # both mean: not before the plan ends
    with pytest.raises(BadModel, match="can't have come to a stand after 4"):
        ModelSet.decode(edited(model, {"stands": 4}))


def test_a_model_set_is_read_from_the_file_that_it_was_saved_in_and_garbage_is_refused(model, tmp_path):
    whole = model.encode()
    for path in (tmp_path / "deep" / "model.safetensors", str(tmp_path / "again")):
        model.save(path)
        assert ModelSet.load(path).version == model.version
    for bad in (b"", b"garbage", whole[:-8], whole[: len(whole) // 2], b"\xff" * 100):
        with pytest.raises(BadModel, match="no model set"):
            ModelSet.decode(bad)
    with pytest.raises(BadModel, match=r"my\.toml is a description: give the model set that `brakeline certify"):
        ModelSet.load("my.toml")
    with pytest.raises(BadModel, match=r"deep is a folder: give the model set in it \(there is model\.safetensors\)"):
        ModelSet.load(tmp_path / "deep")
    with pytest.raises(BadModel, match=r"there is no file .*: `brakeline certify FILE\.toml --use` writes a model set"):
        ModelSet.load(tmp_path / "none.safetensors")
    with pytest.raises(BadModel, match="`brakeline certify --data FILE --use` makes a model set from it"):
        record(trajectories=6, periods=60).save(tmp_path / "record.safetensors")
        ModelSet.load(tmp_path / "record.safetensors")
    path = tmp_path / "model.safetensors"
    with pytest.raises(BadModel, match=str(path)):
        ModelSet.load(path)
    path.write_bytes(whole[:-8])
    with pytest.raises(BadModel, match=str(path)):
        ModelSet.load(path)


def edited(model, metadata=None, **tensors):
    """Return the model's bytes with other tensors or metadata, and the old version."""
    before, about = unpack(model.encode(), ENTRY)
    changed = {name.replace("__", "."): value for name, value in tensors.items()}
    return pack(before | changed, ENTRY, about | (metadata or {}))


def test_tampered_model_sets_are_refused(model):
    assert ModelSet.decode(edited(model)).version == model.version
    first = model.steps[0]
    for changes, message in (
        ({"step0__w": first.w * 0.5}, "version"),
        ({"step0__C": first.C + 1e-12}, "version"),
        ({"step0__w": np.full_like(first.w, np.nan)}, "NaN"),
        ({"latch__w": -model.stopping_distance.w}, "negative width"),
        ({"step1__kappa": -model.steps[1].kappa}, "negative width"),
        ({"step0__w": first.w[:-1]}, "arrays"),
        ({"step2__C": first.C[:, :-1]}, "arrays"),
        ({"bulges__C": model.stopping_distance.C}, "arrays"),
        ({"domain": model.domain[:1]}, "domain"),
        ({"domain": model.domain[::-1].copy()}, "domain"),
        ({"basis": np.zeros_like(model.basis)}, "basis"),
        ({"in_place.box": model.in_place.box[::-1].copy()}, "in place"),
        ({"in_place.box": model.in_place.box[:, :-1]}, "in place"),
        ({"in_place.step0__C": first.C}, "arrays"),
        ({"in_place.step1__w": 2.0 * model.in_place.steps[1].w}, "version"),
        ({"in_place.step1__w": -model.in_place.steps[1].w}, "negative width"),
        ({"basis": model.basis.astype(np.float32)}, "another type"),
    ):
        with pytest.raises(BadModel, match=message):
            ModelSet.decode(edited(model, **changes))
    for metadata, message in (
        ({"robot": "submarine"}, "submarine"),
        ({"layout": "another"}, "layout"),
        ({"layout": None}, "layout"),
        ({"version": "0" * 12}, "version"),
        ({"recipe": "{}x"}, "no model set"),
        ({"recipe": {"certificate": "hope"}}, "hope"),
        ({"recipe": {"inflation": 0.5}}, "bounds nothing"),
        ({"recipe": {"mode": "recursion"}}, "arrays"),
    ):
        with pytest.raises(BadModel, match=message):
            ModelSet.decode(edited(model, metadata))


def test_a_flipped_bit_in_what_a_model_set_states_is_noticed(model):
    stated = replace(model, about=model.about | {"bound_plan": "0.0376"})
    whole = stated.encode()
    assert ModelSet.decode(whole).about == stated.about
    for bit in range(3):
        damaged = bytearray(whole)
        damaged[whole.index(b"0.0376") + 3] ^= 1 << bit
        with pytest.raises(BadModel, match="checksum"):
            ModelSet.decode(bytes(damaged))
    tensors, about = unpack(whole, ENTRY)
    earlier = pack(tensors, ENTRY, {name: value for name, value in about.items() if name != "checksum"})
    assert ModelSet.decode(earlier).version == model.version and ModelSet.decode(earlier).encode() == whole


def test_invalid_configurations_and_data_that_support_no_model_are_refused(data):
    for bad in ({"certificate": "hope"}, {"mode": "magic"}, {"inflation": 0.9}, {"inflation": float("nan")}):
        with pytest.raises(ValueError, match=r"certificate|mode|inflation"):
            ModelConfig(**bad)
    with pytest.raises(BadData, match="trajectory"):
        fit_model_set(replace(data, trajectories=data.trajectories[:1]), ModelConfig())
    with pytest.raises(BadData, match="at least"):
        fit_model_set(record(trajectories=4, periods=60), ModelConfig())
    slow = tuple(replace(t, inputs=t.inputs * [1.0, 0.0]) for t in data.trajectories)
    with pytest.raises((BadData, ErrorBoundError)):
        fit_model_set(replace(data, trajectories=slow), ModelConfig())


@pytest.mark.parametrize("mode", ["auto", "one-step"])
def test_a_mode_that_is_not_fitted_here_is_refused(data, mode):
    """A recursion with the name of that mode counted as mode direct: one of eight verified plans of a puck collided."""
    with pytest.raises(ErrorBoundError, match=f"no mode {mode}.*direct or recursion"):
        fit_model_set(data, ModelConfig(mode=mode))


def test_the_residual_bound_is_the_narrowest_and_the_others_contain_its_fit(models, data, plans):
    w = plans
    widths = {kind: Filter(models[kind, "direct"]).tube.half_widths(w.z[0])[-1].max() for kind in KINDS}
    assert widths["residual"] <= widths["set-membership"] <= widths["matrix-zonotope"]
    fit, _ = data.split((0.5, 0.5))
    seen = windows(fit, 3)
    trusted = least_squares(seen.z, seen.y)
    for kind in ("set-membership", "matrix-zonotope"):
        step = models[kind, "direct"].steps[2]
        off = np.abs(w.z[:500] @ (trusted - step.C).T)
        assert (off <= np.abs(w.z[:500] @ step.W.T) @ step.M.T + 1e-9).all()


# --- tensor files ---------------------------------------------------------------------------------------------------

WORDS = st.dictionaries(st.text(max_size=5), st.one_of(st.text(max_size=5), st.integers(), st.booleans()), max_size=5)
ARRAYS = st.dictionaries(st.text("abcx.", min_size=1, max_size=4), arrays(np.float64, (2, 3)), max_size=3)


@given(ARRAYS, WORDS)
def test_a_packed_file_is_unpacked_unchanged_and_equal_content_gives_equal_bytes(tensors, about):
    payload = pack(tensors, "entry", about)
    loaded, loaded_about = unpack(payload, "entry")
    assert loaded_about == about and loaded.keys() == tensors.keys()
    assert all(loaded[name].tobytes() == tensors[name].tobytes() for name in tensors)
    turned = dict(reversed(list(about.items())))
    assert pack(dict(reversed(list(tensors.items()))), "entry", turned) == payload
    assert content(tensors) == content(loaded)


def test_other_bytes_are_refused_with_a_reason():
    whole = pack({"a": np.arange(6.0)[::2]}, "entry", {"x": 1})
    assert has_entry(whole, "entry") and not has_entry(whole, "another")
    with pytest.raises(BadTensors, match="another"):
        unpack(whole, "another")
    for garbage in (b"", b"garbage", whole[:-1], whole[:20], b"\x02" + b"\0" * 7 + b"[]", b"\xff" * 40):
        assert not has_entry(garbage, "another")
        with pytest.raises(BadTensors):
            unpack(garbage, "entry")
    with pytest.raises(BadTensors, match="no object"):
        unpack(pack({}, "entry", [1]), "entry")


def test_a_file_that_is_called_like_a_robot_does_not_replace_the_model_set_that_comes_with_it(tmp_path, monkeypatch):
    version = ModelSet.load("ground").version
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ground").write_bytes(b"not this one")
    (tmp_path / "quadrotor").mkdir()
    assert ModelSet.load("ground").version == version and ModelSet.load("quadrotor").robot.name == "quadrotor"
    for path in ("./ground", tmp_path / "ground"):
        with pytest.raises(BadModel, match="ground"):
            ModelSet.load(path)
