"""When the certifier makes a new model set of a robot that has changed, from which driving, and when it refuses."""

import os
import re
import subprocess
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from brakeline.deploy.data.certification import certify, certify_update
from brakeline.deploy.interpreter import PYTHON
from brakeline.deploy.run import adaptation, adaptation_process
from brakeline.deploy.run.adaptation import NARROWER, REQUESTS, UPDATED, Adaptation, Recertification
from brakeline.deploy.run.adaptation_process import CertifierSettings, _attempt_if_due, certifier_beside
from brakeline.deploy.run.processes import UNFINISHED
from brakeline.deploy.run.run_keys import check_adaptable, check_signer
from brakeline.errors import BadModel, BadStep, Implausible, Untrusted
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.topics import MODEL
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model import one_step_update
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.error_bounds import ErrorBound
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, RECURSION, ModelConfig, ModelSet
from brakeline.safety.model.one_step_fitting import window_scores
from brakeline.safety.model.set_shape import plans_from
from brakeline.safety.model.validation import most_violations
from brakeline.safety.model.windows import FREE, plan_regressor_map, windows
from brakeline.safety.service.signature import ModelSigner, SignedModel, TrustedSigners, write_signer
from tests.safety.joints import joints
from tests.safety.test_turning_in_place import ROBOT, record, wandering
from tests.safety.unicycle import Unicycle
from tests.waiting import until

ACCEPTED = 0.03
MINUTE = 300  # periods
EPISODE = 200  # periods


@cache
def driven(seed, episodes, slip=0.0, noise=1.0, share=1.0, stops=True):
    """The trajectories of a robot. share: of the inputs' range that it uses."""
    parts = []
    for i in range(episodes):
        rng = np.random.default_rng((seed, i))
        robot = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng, slip=slip, noise=noise)
        inputs = share * wandering(rng, EPISODE)
        parts.append(robot.trajectory(inputs if stops else np.maximum(inputs, [0.05, -9.0])))
    return tuple(parts)


@cache
def in_use():
    return certify(record(1, 6), ModelConfig(mode=ONE_STEP))[0]


def steps_of(trajectories, actor="actor-0", first=0, run=1):
    for number, t in enumerate(trajectories, first):
        for k in range(len(t.inputs)):
            place = {"robot": ROBOT.name, "actor": actor, "episode": number, "step": k}
            moved = {"state": t.states[k + 1], "path": t.paths[k].ravel(), "turned": t.turned[k]}
            yield pb.Step(header=pb.Header(run=run), observation=[1.0], action=t.inputs[k], **place, **moved)


def exchange_of(step, widening, version="old"):
    request = pb.Request(actor=step.actor, episode=step.episode, step=step.step, widening=widening)
    header = pb.Header(run=step.header.run)
    return pb.Exchange(header=header, request=request, reply=pb.Reply(decision=pb.Decision(model=version)))


def drive(kind, trajectories, widening=1.0, version="old", **options):
    """Let a robot drive, and return what comes of the attempts."""
    attempts = []
    for step in steps_of(trajectories, **options):
        kind.exchange(exchange_of(step, widening, version), 0.0)
        kind.step(step)
        if step.step % 20 == 19 and (attempt := kind.attempt()) is not None:
            attempts.append(attempt)
    return attempts


@pytest.fixture(autouse=True, scope="module")
def certified_once():
    """Certify the same driving once in all tests."""
    results = {}

    def certified(data, config):
        digest = data.digest()
        if digest not in results:
            results[digest] = certify(data, config)
        return results[digest]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adaptation, "certify", certified)
        yield


@pytest.fixture
def kind():
    return Adaptation(ROBOT, lambda version: in_use(), ACCEPTED)


def test_a_changed_robot_gets_a_tighter_set_of_what_it_drove_since_the_change(kind):
    assert not drive(kind, driven(1, 3))
    attempts = drive(kind, driven(2, 7, slip=-0.15), widening=8.0, first=3)
    assert len(attempts) == 1 and "4.0 minutes after the change, at 8 times the sets" in attempts[0].text
    model, data = attempts[0].model, attempts[0].data
    before = driven(1, 3)[-1].states[5]
    assert data.periods <= 4 * MINUTE and not any((t.states == before).any() for t in data.trajectories)
    assert model.version != in_use().version and float(model.about["bound_plan"]) <= ACCEPTED
    fresh = Dataset(ROBOT, driven(3, 6, slip=-0.15))
    outside = certify(fresh, ModelConfig(mode=ONE_STEP))[0]
    ratio = [m.steps[-1].w[:2].mean() for m in (model, outside)]
    assert 0.5 < ratio[0] / ratio[1] < 2.0, "as if the changed robot had been recorded"


def test_a_set_that_predicts_plans_only_is_compared_on_plans_as_they_are_widened():
    data = Dataset(ROBOT, driven(2, 7, slip=-0.15))
    free, stops = certify(record(1, 6), ModelConfig(mode=DIRECT, windows=FREE))[0], plan_regressor_map(ROBOT)
    steps, *more = (part.through(stops) for part in free.steps), free.chord_deviations, free.stopping_distance
    chords, stopping = (part.through(stops) for part in more)
    plans = ModelSet(
        ROBOT, ModelConfig(mode=DIRECT), tuple(steps), chords, stopping, free.domain, np.eye(stops.shape[1]), free.about
    )
    begun = plans_from(ROBOT, windows(data, ROBOT.horizon, FREE).z)
    expected = free.steps[-1].half_widths(begun)[:, :2].mean()
    assert adaptation.mean_half_width(plans, data) == pytest.approx(expected)
    new = replace(in_use(), steps=tuple(_wider(step, 4.0) for step in in_use().steps))
    growth = Filter(plans).constraints.growth
    width = adaptation.mean_half_width(new, data)
    even = width / (adaptation.TIGHTER * expected * growth)
    assert growth > 1.1 and even > 1.0, "sets of plans widen by more than a request asks for"
    assert adaptation._largest_half_width(plans, even, data) == pytest.approx(width)
    check_adaptable(plans)


def test_the_next_attempt_waits_for_more_driving_and_the_new_version_ends_the_change(kind):
    (attempt,) = drive(kind, driven(2, 7, slip=-0.15), widening=8.0)
    assert kind.since_change > 4.0
    assert not drive(kind, driven(4, 2, slip=-0.15), version=attempt.model.version, first=7)
    assert kind.since_change == 0.0 and kind.widening == 1.0


@pytest.mark.parametrize("widening", [1.29, 1.0, np.nan])
def test_nothing_is_certified_without_a_change(kind, widening):
    assert not drive(kind, driven(2, 10), widening=widening)


def test_a_hundred_requests_make_a_change(kind):
    steps = list(steps_of(driven(2, 7, slip=-0.15)))
    for step in steps[: REQUESTS - 1]:
        kind.exchange(exchange_of(step, 8.0), 0.0)
    assert not kind._changed()
    kind.exchange(exchange_of(steps[REQUESTS - 1], 8.0), 0.0)
    assert kind._changed()


def test_a_change_of_one_robot_alone_makes_no_set_for_all(kind, monkeypatch):
    monkeypatch.setattr(kind, "_certified", lambda steps, why: Recertification(why))
    assert not drive(kind, driven(5, 2), actor="actor-1")
    assert not drive(kind, driven(2, 8, slip=-0.15), widening=8.0)
    assert kind.widening == 1.0
    for step in steps_of(driven(2, 1, slip=-0.15), first=8):
        kind.exchange(exchange_of(step, 8.0), 31.0)
    assert kind.attempt() is not None, "the other robot has been silent for minutes"


@pytest.mark.parametrize("reply", [None, pb.Reply(error=pb.Error(type="NoModel"))])
def test_a_robot_that_gets_no_decisions_is_no_robot_whose_sets_count(kind, reply):
    """It held up the new set of the others, and its empty version was then the one to compare with."""
    step = next(steps_of(driven(1, 3)))
    for _ in range(REQUESTS):
        kind.exchange(exchange_of(step, 8.0), 0.0)
    lost = pb.Exchange(request=pb.Request(actor="actor-1"), reply=reply, failure="no answer")
    kind.exchange(lost, 1.0)
    assert kind.widening == 8.0 and kind._changed()


def test_a_set_that_was_compared_with_one_no_longer_in_use_is_not_published(kind):
    """A fit takes minutes, and the operator may publish a set meanwhile, with a lower number than the fit's."""
    step = next(steps_of(driven(1, 3)))
    kind.exchange(exchange_of(step, 8.0, "old"), 0.0)
    attempt = Recertification("why", in_use(), replaces="old")
    assert kind.confirmed(attempt) is attempt
    kind.exchange(exchange_of(step, 1.0, "theirs"), 1.0)
    confirmed = kind.confirmed(attempt)
    assert confirmed.model is None and "theirs came into use during the fit" in confirmed.text


def test_robots_that_are_gone_make_room_for_others(kind, monkeypatch):
    monkeypatch.setattr(adaptation, "MOST_ROBOTS", 2)
    step, later = next(steps_of(driven(1, 3))), adaptation.SILENT + 1.0
    for name, heard in (("a", 0.0), ("b", later), ("c", later)):
        step.actor = name
        kind.exchange(exchange_of(step, 1.0), heard)
    assert sorted(kind._robots) == ["b", "c"]
    step.actor = "d"
    with pytest.raises(Implausible, match="already 2 robots"):
        kind.exchange(exchange_of(step, 1.0), later)


def test_a_break_begins_the_change_anew(kind):
    trajectories = driven(2, 8, slip=-0.15)
    assert not drive(kind, trajectories[:4], widening=8.0)
    assert not drive(kind, trajectories[4:5], first=4)
    assert not drive(kind, trajectories[5:], widening=8.0, first=5)
    assert kind.since_change == pytest.approx(3 * EPISODE / MINUTE)
    assert not drive(kind, trajectories[:5], widening=8.0, run=2), "a process that was started again"
    assert kind.since_change == pytest.approx(5 * EPISODE / MINUTE)


@pytest.mark.parametrize(
    ("why", "widening", "options"),
    [
        ("times as wide as those in use", 1.31, {"noise": 2.0}),
        ("stops in the data", 8.0, {"slip": -0.15, "stops": False}),
    ],
)
def test_a_looser_or_an_unproven_set_is_refused_with_the_reason(kind, why, widening, options):
    (attempt,) = drive(kind, driven(2, 7, **options), widening=widening)
    assert attempt.text.count(why) == 2, "a fit and an update"
    assert attempt.model is None and attempt.data is None and why in attempt.text


def test_a_set_with_which_a_robot_could_no_longer_stand_is_refused(kind, monkeypatch):
    monkeypatch.setattr(adaptation, "room_to_stand", lambda model: 0.1 if model is in_use() else 0.81)
    (attempt,) = drive(kind, driven(2, 7, slip=-0.15), widening=8.0)
    room = 0.1 * Filter(in_use()).constraints.plan_widening(8.0)
    assert room == 0.8 and attempt.model is None
    assert attempt.text.count("a standing robot needs 0.81 m of room; with the set in use, as widened, 0.80 m") == 2


def test_driving_that_is_too_narrow_makes_no_set(kind):
    (attempt,) = drive(kind, driven(2, 7, slip=-0.15, share=0.4), widening=8.0)
    assert attempt.model is None and re.search(r"of the range of \w+ .*\[.+\] in the set in use, not 50%", attempt.text)


def test_narrow_driving_makes_a_set_that_keeps_the_robot_within_it():
    """An update would keep the range of the set in use, where the new driving shows nothing."""
    sets = {"old": in_use()}
    (attempt,) = drive(Adaptation(ROBOT, sets.__getitem__, ACCEPTED), driven(2, 7, slip=-0.15, share=0.6), widening=8.0)
    new = attempt.model
    assert new.about[NARROWER] and "a fit to this driving" in attempt.text and "of its range" in attempt.text
    assert (np.ptp(new.domain, axis=0) < UPDATED * np.ptp(in_use().domain, axis=0)).any()
    assert share_outside(new, Dataset(ROBOT, driven(3, 6, slip=-0.15, share=0.6))) <= float(new.about["bound_plan"])
    sets["new"] = new
    kind = Adaptation(ROBOT, sets.__getitem__, ACCEPTED)
    (again,) = drive(kind, driven(4, 7, slip=-0.3, share=0.4), widening=8.0, version="new")
    assert again.model is None and "not 75%" in again.text, "it would become slower with each set"
    kind = Adaptation(ROBOT, sets.__getitem__, ACCEPTED)
    (wide,) = drive(kind, driven(5, 7, slip=-0.3, share=0.6), widening=8.0, version="new")
    assert wide.model is not None and wide.model.about[NARROWER] == new.about[NARROWER], "nor after a set of all of it"


def test_an_update_of_the_set_in_use_holds_on_fresh_driving():
    new, report = certify_update(in_use(), Dataset(ROBOT, driven(2, 7, slip=-0.15, share=0.5)), ModelConfig.outside)
    assert (new.domain[0] <= in_use().domain[0]).all() and (new.domain[1] >= in_use().domain[1]).all()
    assert float(new.about["bound_plan"]) == pytest.approx(report.bound_plan, rel=1e-5)
    assert report.bound_plan <= ACCEPTED and new.about["updates"] == in_use().version
    assert ModelSet.decode(new.encode()).version == new.version
    fresh = Dataset(ROBOT, driven(3, 6, slip=-0.15, share=0.5))
    assert share_outside(in_use(), fresh) > 0.2 > ACCEPTED > share_outside(new, fresh)


def test_an_update_whose_rollouts_diverge_leaves_every_set():
    """Infinity divided by infinity is no number, and no number is above 1."""
    s = samples_of(Dataset(ROBOT, driven(2, 2)).joined())
    shapes = s.after.shape[1:], s.after.shape[1:2]
    without_end = SimpleNamespace(
        rollouts_with_stretch=lambda robot, z: tuple(np.full((len(z), *shape), np.inf) for shape in shapes)
    )
    correction = SimpleNamespace(gram=range(int(s.fold.max()) + 1), fit=lambda *choice, without: without_end)
    widths = np.ones((*s.after.shape[:2], s.after.shape[2] + 1))
    used = one_step_update._shares_used(ROBOT, s, correction, (1.0, False), widths)
    assert np.isinf(window_scores(ROBOT, used)[0].max(0)).all()


def share_outside(model, data):
    """The share of windows that leave the sets of positions."""
    s = samples_of(data.joined())
    predicted, stretch = model.one_step.rollouts_with_stretch(ROBOT, s.z)
    errors = (s.after - predicted) / stretch[..., None]
    half_widths = np.stack([step.half_widths(s.z) for step in model.steps], 1)
    return float((np.abs(errors) > half_widths)[..., : ROBOT.position_dim].any((1, 2)).mean())


def test_the_certifier_says_how_much_driving_is_missing(kind):
    process = SimpleNamespace(notes={}, figures={}, announce=lambda: None)
    trajectories = driven(2, 7, slip=-0.15)
    drive(kind, trajectories[:1])
    _attempt_if_due(kind, lambda: None, None, process)
    assert not process.notes
    drive(kind, trajectories[1:4], widening=8.0, first=1)
    _attempt_if_due(kind, lambda: None, None, process)
    plans = int(process.figures[f"plans since the change {ROBOT.name}"])
    assert plans == 3 * ((EPISODE - 1) // ROBOT.horizon), "an episode's first step is the start of a trajectory"
    note = process.notes[f"adaptation {ROBOT.name}"]
    assert f"waiting: {plans} of the {kind.plans_needed} plans since the change that state 3 %" in note
    assert f"{max(2.0, 2.0 * (kind.plans_needed - plans) / plans):.1f} minutes left" in note, "four at least"
    drive(kind, trajectories[4:5], first=4)
    _attempt_if_due(kind, lambda: None, None, process)
    assert not process.notes, "the change is over"


def test_a_change_lasts_until_the_stated_sets_hold_again(kind):
    steps = list(steps_of(driven(2, 7, slip=-0.15)))
    for widening, changed in ((1.2, False), (1.4, True), (1.2, True), (1.05, False), (1.2, False)):
        for step in steps[:REQUESTS]:
            kind.exchange(exchange_of(step, widening), 0.0)
        assert kind._changed() == changed, widening


def test_a_new_set_lets_out_no_more_than_the_set_in_use_and_the_accepted_bound_do(kind):
    loose = replace(in_use(), model_config=replace(in_use().model_config, outside=0.05))
    data = Dataset(ROBOT, driven(2, 7, slip=-0.15))
    plans = sum(len(t.inputs) // ROBOT.horizon for t in data.trajectories)
    assert kind._outside(in_use(), data) == ModelConfig.outside
    assert kind._outside(loose, data) == most_violations(plans, ACCEPTED) / plans
    kind.accept_bound = 0.5
    assert kind._outside(loose, data) == 0.05


def test_what_cannot_state_the_accepted_bound_is_not_tried():
    kind = Adaptation(ROBOT, lambda version: in_use(), 0.01)
    assert kind.needed > 9 * MINUTE
    assert not drive(kind, driven(2, 7, slip=-0.15), widening=8.0)


def test_a_set_that_states_more_than_is_accepted_is_refused(kind, monkeypatch):
    monkeypatch.setattr(Adaptation, "plans_needed", 10)
    kind.accept_bound = 0.005
    (attempt,) = drive(kind, driven(2, 7, slip=-0.15), widening=8.0)
    assert attempt.model is None and "states only that at most" in attempt.text


def test_a_version_that_is_not_known_is_not_replaced():
    def unknown(version):
        raise BadModel(f"no {version}")

    (attempt,) = drive(Adaptation(ROBOT, unknown, ACCEPTED), driven(2, 7, slip=-0.15), widening=8.0)
    assert attempt.model is None and "no old" in attempt.text


@pytest.mark.long
def test_without_a_change_a_set_is_replaced_by_a_tighter_one_after_a_quarter_of_an_hour():
    wide = replace(in_use(), steps=tuple(_wider(step, 2.0) for step in in_use().steps))
    attempts = drive(Adaptation(ROBOT, lambda version: wide, ACCEPTED), driven(6, 23))
    assert len(attempts) == 1 and attempts[0].model is not None and "15.0 minutes without" in attempts[0].text


def _wider(bound: ErrorBound, by: float) -> ErrorBound:
    return replace(bound, kappa=by * bound.kappa, w=by * bound.w)


def test_the_memory_is_bounded_and_steps_of_the_wrong_size_are_rejected(kind):
    step = next(steps_of(driven(1, 3)))
    for _ in range(21 * MINUTE):
        kind.step(pb.Step.FromString(step.SerializeToString()))
    assert len(kind._steps) == 20 * MINUTE and not kind._steps[-1].observation
    for wrong in ({"state": [0.0]}, {"action": [0.0]}, {"path": [0.0]}, {"path": []}, {"turned": np.nan}):
        broken = pb.Step.FromString(step.SerializeToString())
        for name, value in wrong.items():
            broken.ClearField(name)
            broken.MergeFrom(pb.Step(**{name: value}))
        with pytest.raises(BadStep):
            kind.step(broken)


def test_the_process_signs_what_it_publishes_and_goes_on_after_an_error(kind, tmp_path, monkeypatch, caplog):
    published = []
    bus = SimpleNamespace(
        publisher=lambda topic, robot: SimpleNamespace(put=lambda model: published.append((topic, model)))
    )
    process = SimpleNamespace(bus=bus, notes={}, figures={}, announce=lambda: None)
    write_signer(tmp_path)
    signer, data = ModelSigner.load(tmp_path), Dataset(ROBOT, record(1, 6).trajectories)
    kind.exchange(exchange_of(next(steps_of(driven(1, 3))), 1.0, "old"), 0.0)
    attempts = [None, Recertification("why", in_use(), data, "old"), Recertification("no")]
    attempt = Mock(side_effect=[ZeroDivisionError("one of these"), *attempts])
    monkeypatch.setattr(kind, "attempt", attempt)
    _attempt_if_due(kind, lambda: None, signer, process)
    assert "one of these" in process.notes[f"adaptation {ROBOT.name}"] and "no new model set" in caplog.text
    for _ in range(3):
        _attempt_if_due(kind, lambda: None, signer, process)
    ((topic, message),) = published
    assert topic is MODEL
    signed = SignedModel(message.file, message.claim, message.signature)
    assert TrustedSigners.load(tmp_path).open(signed, ROBOT.name).version == message.version
    assert process.figures[f"published {ROBOT.name}"] == process.figures[f"refused {ROBOT.name}"] == 1.0
    assert process.notes[f"adaptation {ROBOT.name}"] == "no"


FITTING = """
import threading
import numpy as np
from proxsuite import proxqp
from brakeline.deploy.run.adaptation_process import _end

def fit():
    while True:
        qp = proxqp.dense.QP(40, 0, 40)
        qp.init(np.eye(40), np.ones(40), None, None, np.eye(40), -np.ones(40), np.ones(40))
        qp.solve()
        begun.set()

begun, worker = threading.Event(), threading.Thread(target=fit, daemon=True)
worker.start()
begun.wait()
_end(worker)
"""


def test_a_certifier_that_is_asked_to_end_in_a_fit_ends_without_an_abort():
    """A real one printed "terminate called without an active exception", or what the solver leaked."""
    done = subprocess.run([*PYTHON, "-c", FITTING], check=False, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stderr) == (UNFINISHED, "")


@pytest.mark.parametrize("leaves", [False, True])
def test_a_service_says_that_the_certifier_beside_it_has_ended(monkeypatch, caplog, leaves):
    """It went on without a word, and no set was ever replaced. ^C ends both, and is nothing to report."""
    sentinel, certifier = os.pipe()
    process = SimpleNamespace(sentinel=sentinel, **dict.fromkeys(("start", "terminate", "kill"), lambda: None))
    process.join = lambda timeout: None
    monkeypatch.setattr(adaptation_process, "spawning", lambda: SimpleNamespace(Process=lambda **_: process))
    if not leaves:
        monkeypatch.setattr(adaptation_process, "TERMINATION_TIMEOUT", 0.05)
    with certifier_beside(CertifierSettings(BusSettings(listen=("tls/127.0.0.1:1",)), (ROBOT.name,), Path())):
        os.close(certifier)
        if not leaves:
            until(lambda: "the certifier has ended" in caplog.text)
    for thread in threading.enumerate():
        if thread.name == "certifier":
            thread.join()
    os.close(sentinel)
    assert ("the certifier has ended" in caplog.text) != leaves


def test_nothing_adapts_without_a_key_to_sign_or_with_a_set_of_mode_recursion(tmp_path):
    with pytest.raises(Untrusted, match="--adapt needs keys"):
        check_signer(None)
    with pytest.raises(Untrusted, match="no key to sign models with"):
        check_signer(tmp_path)
    check_adaptable(in_use())
    with pytest.raises(ValueError, match="2-joints has none: certify it by hand"):
        check_adaptable(SimpleNamespace(robot=joints(2)))
    with pytest.raises(ValueError, match="--mode one-step"):
        check_adaptable(replace(in_use(), model_config=ModelConfig(mode=RECURSION)))
