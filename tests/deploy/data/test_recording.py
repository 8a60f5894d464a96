"""Recording, storing, and data from a log."""

import itertools
import json
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from brakeline.deploy.cli import main
from brakeline.deploy.data import collect, data_paths, model_store, patient_save, simulated_recording
from brakeline.deploy.data.build_lock import LOCK
from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.excitation import excitation, restless_excitation
from brakeline.deploy.data.partial_save import PartialSave
from brakeline.deploy.data.run_dataset import from_log, trajectories_of
from brakeline.errors import BadData, BadModel, NoBatch
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.acceleration_age import ENTRY
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.driving_kinds import JUMPING, RESTLESS, driving_kinds
from brakeline.safety.model.model_config import AUTO
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.windows import windows
from brakeline.sim.batch import batch_support
from brakeline.sim.sim_conditions import Conditions, NoiseLevels
from tests.accepting import BOUND
from tests.full_disk import full_disk
from tests.logs.sample_log import written
from tests.robots import GROUND, QUADROTOR
from tests.safety.toys import car
from tests.waiting import PATIENCE

MAKE = """
from brakeline.deploy.data import model_store, simulated_recording
from brakeline.messaging.task import robot_with_task
from brakeline.safety.model.model_config import ModelConfig
simulated_recording.load_or_record(robot_with_task("ground"), trajectories=8)
model_store.model_for(robot_with_task("ground"), ModelConfig(), 0.3)
"""


def test_excitation_stays_in_bounds_and_slew_and_holds_plans_of_the_schedule():
    inputs = np.array(list(itertools.islice(excitation(GROUND, np.random.default_rng(1)), 20_000)))
    assert ((inputs >= GROUND.low()) & (inputs <= GROUND.high())).all()
    steps = np.abs(np.diff(inputs, axis=0, prepend=np.zeros((1, 2))))
    assert (steps <= np.asarray(GROUND.action_slew) + 1e-12).all()
    moving = inputs.any(1)
    stops = np.flatnonzero(moving[:-2] & ~moving[1:-1] & ~moving[2:])
    assert len(stops) > 1000, "plans to a stop"
    edges = (inputs[moving] == GROUND.high()).mean(0)
    assert (edges > 0.1).all(), "inputs at their bounds, as when driving"
    lengths = [len(list(group)) for still, group in itertools.groupby(~moving) if still]
    assert max(lengths) >= 10, "some long stops, for the latch"


@pytest.mark.parametrize("late", [False, True])
def test_a_robot_without_a_model_set_says_why_it_is_recorded_and_for_how_long(monkeypatch, tmp_path, capsys, late):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    monkeypatch.setattr(model_store, "_shipped", lambda robot: None)
    monkeypatch.setattr(simulated_recording, "data_for", lambda robot: pytest.exit("it would record"))
    robot = GROUND.in_real_time() if late else GROUND
    with pytest.raises(pytest.exit.Exception):
        model_store.model_for(robot, ModelConfig())
    said = " ".join(capsys.readouterr().err.split())
    assert f"{robot.name}: it has no model set yet" in said and "takes minutes" in said
    assert ("none for real time comes with Brakeline" in said) == late


@pytest.mark.parametrize(("held", "least", "most"), [(25, 0.06, 0.2), (3, 0.0, 0.03)])
def test_lead_ins_of_inputs_held_for_long_are_sometimes_restless(held, least, most):
    robot = car("restless", stop=("ramp", "hold"))
    inputs = np.array(list(itertools.islice(excitation(robot, np.random.default_rng(1), held), 20_000)))
    at_bounds = ((inputs == robot.low()) | (inputs == robot.high())).all(1)
    restless = at_bounds[:-1] & at_bounds[1:] & (inputs[1:, 1] == -inputs[:-1, 1])
    assert least < restless.mean() < most


def test_recorded_plans_are_found_as_windows(data_folder):
    data = Dataset.load(data_paths.record_path(GROUND))
    assert len(windows(data, GROUND.horizon)) > 0.1 * data.periods
    assert {len(t.inputs) for t in data.steady().trajectories} == {300}


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.name)
def test_restless_driving_jumps_in_its_plans_at_speed_and_with_all_inputs_together(robot):
    inputs = np.array(list(itertools.islice(restless_excitation(robot, np.random.default_rng(1)), 6000)))
    steps = np.abs(np.diff(inputs, axis=0, prepend=np.zeros((1, robot.action_dim))))
    slew = np.asarray(robot.action_slew)
    assert ((inputs >= robot.low()) & (inputs <= robot.high())).all() and (steps <= slew + 1e-12).all()
    N = robot.horizon
    at = np.arange(0, len(inputs) - N, N)[:, None] + np.arange(N + 1)  # with the input in force before
    z = np.hstack([np.zeros((len(at), len(robot.regressor))), inputs[at].reshape(len(at), -1)])
    kinds = driving_kinds(robot, z, np.ones((len(at), 2), dtype=int))
    restless = kinds[RESTLESS] | kinds[JUMPING]
    assert restless.mean() > 0.2
    assert (np.abs(inputs) == robot.high()).all(1).mean() > 0.04, "all inputs at a bound together"
    at_bound = np.array([kind.mean() for name, kind in kinds.items() if name.endswith("at its bound")])
    assert len(at_bound) == robot.action_dim and (at_bound > 0.03).all(), "trained policies cruise"


def test_a_recording_ends_with_restless_starts_and_the_rest_of_it_stays_what_it_was(data_folder):
    data = Dataset.load(data_paths.record_path(GROUND))
    steady = data.steady()
    restless = data.trajectories[len(steady.trajectories) :]
    assert len(restless) == (len(steady.trajectories) + 1) // 2 == int(data.about["restless"])
    assert {len(t.inputs) for t in restless} == {120}
    first = next(collect.record(GROUND, 1, simulated_recording.SEED, Conditions()))
    assert (first.states == steady.trajectories[0].states).all()
    assert "restless" not in steady.about
    few = replace(data, trajectories=(*steady.trajectories[:8], *restless[:4]), about=data.about | {"restless": "4"})
    assert certify(few, ModelConfig())[0].version == certify(few.steady(), ModelConfig())[0].version
    assert few.steady().digest() != few.digest()


@pytest.mark.parametrize(
    ("robot", "conditions"),
    [(GROUND, Conditions(NoiseLevels(scale=0.5), payload_kg=0.4)), (QUADROTOR, Conditions())],
    ids=["ground", "quadrotor"],
)
def test_many_robots_at_once_record_what_one_after_the_other_records(robot, conditions, monkeypatch):
    many = list(collect.record(robot, 2, 5, conditions, restless=1))
    later = list(collect.record(robot, 2, 5, conditions, first=1, restless=1))

    def refuse(robot, conditions):
        raise NoBatch("one by one")

    monkeypatch.setattr(batch_support, "check_vehicles", refuse)
    singles = list(collect.record(robot, 2, 5, conditions, restless=1))
    assert [len(t.inputs) for t in many] == [300, 300, 120]
    for one, other in zip([*many, *later], [*singles, *singles[1:]], strict=True):
        assert (one.inputs == other.inputs).all() and one.before is other.before is None
        for name in ("states", "paths", "turned"):
            assert np.abs(getattr(one, name) - getattr(other, name)).max() < 1e-7, name


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty store, with small recordings only."""
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    recordings, record, load_or_record = [], collect.record_parts, simulated_recording.load_or_record

    def few(robot, path=None, trajectories=8, *how, **more):
        return load_or_record(robot, path, trajectories, *how, **more)

    monkeypatch.setattr(simulated_recording, "load_or_record", few)
    monkeypatch.setattr(collect, "record_parts", lambda *how: (recordings.append(how), record(*how))[1])
    return recordings


@pytest.fixture
def short(monkeypatch):
    """Trajectories of a few periods: they are too short to certify."""
    monkeypatch.setattr(collect, "PERIODS", 60)
    monkeypatch.setattr(collect, "RESTLESS_PERIODS", 30)


def test_a_robot_without_a_recording_uses_the_model_set_that_comes_with_it(elsewhere):
    automatic = ModelConfig(mode=AUTO)
    model = model_store.model_for(GROUND, automatic)
    assert model.version == ModelSet.load("ground").version and not elsewhere
    assert ModelSet.load(data_paths.model_path(GROUND, automatic)).version == model.version
    late = replace(QUADROTOR, name="another")
    assert model_store._shipped(late) is None and model_store._shipped(GROUND.in_real_time()) is None
    data_paths.model_path(GROUND, automatic).unlink()
    model_store.model_for(GROUND, ModelConfig(), BOUND)  # asked for by its mode, so it is built from data
    data_paths.model_path(GROUND, automatic).unlink()
    assert model_store.model_for(GROUND, automatic, BOUND).version != model.version, "there is a recording"
    assert len(elsewhere) == 1


def test_an_automatic_mode_that_cannot_be_fitted_names_the_command_for_the_other(elsewhere, short):
    simulated_recording.load_or_record(GROUND, None, 2)
    with pytest.raises(BadData, match=r"mode direct cannot be fitted: .*`brakeline certify DESCRIPTION --use`"):
        model_store.model_for(GROUND, ModelConfig(mode=AUTO))


def test_the_store_makes_what_is_missing_and_only_that(elsewhere, capsys):
    model = model_store.model_for(GROUND, ModelConfig(), BOUND)
    assert data_paths.record_path(GROUND).exists() and len(elsewhere) == 1
    assert ModelSet.load(data_paths.model_path(GROUND, ModelConfig())).version == model.version
    assert model_store.model_for(GROUND, ModelConfig(), BOUND).version == model.version
    other = model_store.model_for(GROUND, ModelConfig("matrix-zonotope"), BOUND)
    assert other.version != model.version and len(elsewhere) == 1, "one recording for all"
    assert float(model.about["bound_step"]) <= float(model.about["bound_plan"]) < 1.0
    data_paths.model_path(GROUND, ModelConfig()).write_bytes(b"damaged")
    assert model_store.model_for(GROUND, ModelConfig(), BOUND).version == model.version
    said = capsys.readouterr()
    assert "building the model set again" in said.err and said.out == ""
    data_paths.model_path(GROUND, ModelConfig()).unlink()
    data_paths.record_path(GROUND).write_bytes(b"damaged")
    assert model_store.model_for(GROUND, ModelConfig(), BOUND).version == model.version, "the same seed, the same data"
    assert len(elsewhere) == 2


def test_what_an_older_simulator_recorded_is_recorded_again_and_kept_aside(data_folder, tmp_path, monkeypatch, capsys):
    """So is a model set of such a recording; one of a log stays in use."""
    older = replace(GROUND, task=replace(GROUND.task, simulator_version=1))
    data = Dataset.load(data_paths.record_path(GROUND))
    model = ModelSet.load(data_paths.model_path(GROUND, ModelConfig()))
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    path, model_path = data_paths.record_path(GROUND), data_paths.model_path(GROUND, ModelConfig())
    replace(data, about={name: value for name, value in data.about.items() if name != "simulator_version"}).save(path)
    assert simulated_recording.load_or_record(older).digest() == data.digest(), "no version is the first one"
    fresh = simulated_recording.load_or_record(GROUND, trajectories=1)
    assert len(fresh.trajectories) == 2 and fresh.about["simulator_version"] == "2"
    assert Dataset.load(path.with_suffix(".replaced")).digest() == data.digest()
    assert "before the simulator of ground changed" in " ".join(capsys.readouterr().err.split())
    replace(model, about=model.about | {"simulator_version": "1"}).save(model_path)
    assert model_store.model_for(older, ModelConfig()).version == model.version
    with pytest.raises(BadModel, match="simulator of ground has changed"):
        model_store.model_for(GROUND, ModelConfig(), build=False)
    replace(model, about=model.about | {"simulator_version": "1", "origin": "log"}).save(model_path)
    assert model_store.model_for(GROUND, ModelConfig()).version == model.version
    assert model_store._shipped(GROUND) and not model_store._shipped(older)


def test_of_two_that_find_nothing_one_records_and_the_other_waits_for_it(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    both = [subprocess.Popen([sys.executable, "-c", MAKE], stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=PATIENCE)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert sorted(text.count("recording ground once") for text in said) == [0, 1], said
    assert any("waiting for it to finish" in text for text in said), said
    assert not list((tmp_path / "data").rglob("*.new"))


def test_what_is_imported_is_not_recorded_over(elsewhere, short, monkeypatch, capsys):
    """Neither while it is recorded, nor by a changed description, nor by `brakeline collect`."""
    data = simulated_recording.load_or_record(GROUND, trajectories=1)
    driven = replace(data, about={"origin": "a log", "source": "drive.csv", "sources": "drive.csv"})
    path, record = data_paths.record_path(GROUND), collect.record_parts

    def interrupted(*how):
        driven.save(path)
        yield from record(*how)

    monkeypatch.setattr(collect, "record_parts", interrupted)
    for again in (True, False):
        path.unlink()
        with pytest.raises(BadData, match="is kept"):
            simulated_recording.load_or_record(GROUND, trajectories=1, again=again)
        assert Dataset.about_of(path)["source"] == "drive.csv"
    with pytest.raises(BadData, match="is kept"):
        simulated_recording.load_or_record(GROUND, trajectories=1, again=True)
    before = path.read_bytes()
    with pytest.raises(BadData, match=r"kept: .* \(a log.*import the log again"):
        model_store.model_for(replace(GROUND, period=0.1), ModelConfig())
    assert main(["collect", "ground", "--trajectories", "1"]) == 1
    assert "drive.csv" in capsys.readouterr().err and path.read_bytes() == before


def steps(actor: str, episode: int, numbers, run: int = 1) -> list[pb.Step]:
    """Steps of an actor's episode; the state tells which."""
    made = []
    for number in numbers:
        path = [0.0] * 8
        step = pb.Step(robot="ground", actor=actor, episode=episode, step=number, turned=0.0, path=path)
        step.state.extend([0.0, 0.0, 0.0, episode, number])
        step.action.extend([0.1, 0.01 * (number % 10)])
        step.header.run = run
        made.append(step)
    return made


def test_trajectories_from_a_log_are_cut_at_gaps_episodes_actors_and_restarts():
    log = [
        *steps("a", 0, [*range(10), *range(12, 30)]),  # two steps were lost
        *steps("b", 0, range(10)),
        *steps("a", 1, range(8)),
        *steps("a", 1, range(8, 20), run=2),
        *steps("a", 2, range(4)),  # too short to keep
    ]
    log += log[5:25]  # a copy of a part of the log
    np.random.default_rng(0).shuffle(log)
    found = sorted((int(t.states[0, 3]), int(t.states[0, 4]), len(t.inputs)) for t in trajectories_of(log, GROUND))
    assert found == [(0, 0, 9), (0, 0, 9), (0, 12, 17), (1, 0, 7), (1, 8, 11)]
    for t in trajectories_of(log, GROUND):
        assert (np.diff(t.states[:, 4]) == 1).all() and (t.states[:, 3] == t.states[0, 3]).all()
        assert np.allclose(t.before, [0.1, 0.01 * (t.states[0, 4] % 10)]), "the input in force at its start"
        assert np.allclose(t.inputs[:, 1], 0.01 * (t.states[1:, 4] % 10))


def test_steps_that_the_vehicle_did_not_follow_are_in_no_trajectory():
    log = steps("a", 0, range(30))
    for step in log[10:14]:
        step.lost = True
    found = [(int(t.states[0, 4]), len(t.inputs)) for t in trajectories_of(log, GROUND)]
    assert found == [(0, 9), (14, 15)]


def test_episodes_that_a_restarted_actor_drove_again_count_once(tmp_path):
    """It began again with the same seeds; the last episode of the first session was cut."""
    episodes = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 80, 3))

    def session(run, lengths):
        for number, length in enumerate(lengths):
            for k, (a, b, c) in enumerate(episodes[number][:length]):
                about = {"actor": "a", "robot": "ground", "episode": number, "step": k, "header": pb.Header(run=run)}
                place = [0.001 * k, 0.001 * a]
                yield pb.Step(**about, state=[*place, 0.0, 0.0, c], action=[0.1, b], path=place * 10)

    log = [*session(1, (80, 60)), *session(2, (80, 80, 80))]
    written(tmp_path / "run.mcap", ((f"step/ground/{s.actor}", s, i) for i, s in enumerate(log)))
    data, said = from_log(tmp_path / "run.mcap", GROUND, len(log))
    assert sorted(len(t.inputs) for t in data.trajectories) in ([59, 79, 79], [79, 79, 79])
    assert "2 repeated episodes left out" in said


def test_the_last_steps_of_a_log(tmp_path):
    made = [*steps("a", 0, range(50)), *steps("a", 1, range(50))]
    log = written(tmp_path / "run.mcap", (("step/ground/a", step, i) for i, step in enumerate(made)))
    data, note = from_log(log, GROUND, last=60)
    assert [len(t.inputs) for t in data.trajectories] == [9, 49]
    assert "58 of the last 60 steps" in note and data.about == {"origin": "log"}
    for step in made:
        step.acceleration_age = 0.2
    aged = written(tmp_path / "aged.mcap", (("step/ground/a", step, i) for i, step in enumerate(made)))
    assert from_log(aged, GROUND, last=60)[0].about == {"origin": "log", ENTRY: "0.2"}
    with pytest.raises(BadData, match="no trajectory of ground"):
        from_log(written(tmp_path / "none.mcap", ()), GROUND, last=60)


def test_options_that_a_log_of_a_run_ignores_are_refused(tmp_path, capsys):
    made = [(f"step/ground/{step.actor}", step, i) for i, step in enumerate(steps("a", 0, range(50)))]
    log, out = str(written(tmp_path / "run.mcap", made)), str(tmp_path / "data.safetensors")
    words = ["import", log, "--robot", "ground", "--out", out]
    for ignored in ("--delay", "0.1"), ("--hold", "2"), ("--unit", "heading=deg"), ("--map", "speed=v"):
        assert main([*words, *ignored]) == 1
        assert f"{ignored[0]} would do nothing: leave that out" in " ".join(capsys.readouterr().err.split())
    main(words)
    assert "would do nothing" not in capsys.readouterr().err


def test_steps_of_another_description_are_refused(tmp_path):
    """A step of 0.2 s is none of 0.1 s, and a state in another order is another state. A plan may be longer."""
    made = [(f"step/ground/{step.actor}", step, i) for i, step in enumerate(steps("a", 0, range(50)))]
    described = {"robots": {"ground": json.dumps(replace(GROUND, horizon=GROUND.horizon + 1).description)}}
    log = written(tmp_path / "run.mcap", made, described)
    assert from_log(log, GROUND, last=60)[0].periods == 49
    state = (*GROUND.state[:-2], *GROUND.state[:-3:-1])
    for robot, word in ((replace(GROUND, period=0.1), "period"), (replace(GROUND, state=state), "coordinates")):
        with pytest.raises(BadData, match=rf"another description of ground: {word} differ.*robot new ground.toml"):
            from_log(log, robot, last=60)


def interrupt(monkeypatch, after: int, failure: type[BaseException]) -> None:
    """Let every recording fail after so many trajectories."""
    parts = collect.record_parts

    def interrupted(*given):
        yield next(parts(*given))[:after]
        raise failure

    monkeypatch.setattr(collect, "record_parts", interrupted)


@pytest.mark.parametrize("failure", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_recording_is_gone_on_from(elsewhere, short, monkeypatch, capsys, failure):
    with monkeypatch.context() as patch:
        interrupt(patch, 2, failure)
        with pytest.raises(failure):
            simulated_recording.load_or_record(GROUND, trajectories=4)
    assert not data_paths.record_path(GROUND).exists()
    assert "recording ground once" in (told := capsys.readouterr().err) and "kept 2 of 6" in told
    whole = simulated_recording.load_or_record(GROUND, trajectories=4)
    assert elsewhere[-1][4] == 2, "only what was missing is driven"
    assert {path.name for path in data_paths.record_path(GROUND).parent.iterdir()} == {"record.safetensors", LOCK}
    again = data_paths.record_path(GROUND).with_name("fresh.safetensors")
    fresh = simulated_recording.load_or_record(GROUND, again, trajectories=4)
    assert whole.digest() == fresh.digest(), "the same data as in one go"


def test_an_interrupted_recording_of_another_number_of_trajectories_is_not_gone_on_from(short, monkeypatch, tmp_path):
    """With 4 trajectories there are as many restless ones as with 3, but they begin one place later."""
    path = tmp_path / "record.safetensors"
    with monkeypatch.context() as patch:
        interrupt(patch, 5, KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            simulated_recording.load_or_record(GROUND, path, trajectories=4)
    other = simulated_recording.load_or_record(GROUND, path, trajectories=3)
    fresh = simulated_recording.load_or_record(GROUND, tmp_path / "fresh.safetensors", trajectories=3)
    assert other.digest() == fresh.digest() and len(other.steady().trajectories) == 3


def test_flights_that_were_cut_off_replace_each_other_nowhere(tmp_path):
    part = tmp_path / "flown.part.safetensors"
    for flight in (b"first", b"second", b"third"):
        part.write_bytes(flight)
        PartialSave(part).finish()
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    names = (f"flown.part.earlier{number}.safetensors" for number in ("", 2, 3))
    assert kept == dict(zip(names, (b"first", b"second", b"third"), strict=True))


def test_a_killed_recording_loses_no_trajectory_that_is_finished(short, monkeypatch, tmp_path):
    """Robots that a batch simulates finish together: all are saved before the next ones begin."""
    monkeypatch.setattr(collect, "AT_ONCE", 3)
    record_at_once, path = collect._recorded_at_once, tmp_path / "record.safetensors"
    times, saved = iter(range(0, 1000, 30)), []

    def slow(robot, recipes, conditions):
        if recipes[0].number:
            saved.append(len(Dataset.load(path.with_name("record.part.safetensors")).trajectories))
        now = next(times)
        monkeypatch.setattr(simulated_recording, "time", SimpleNamespace(monotonic=lambda: now))
        return record_at_once(robot, recipes, conditions)

    monkeypatch.setattr(collect, "_recorded_at_once", slow)
    monkeypatch.setattr(simulated_recording, "time", SimpleNamespace(monotonic=lambda: -30))
    simulated_recording.load_or_record(GROUND, path, 6)
    assert saved == [3, 6]


def test_a_recording_on_a_full_disk_goes_on_and_waits_for_room(monkeypatch, tmp_path, capsys):
    """A partial save that fails does not end the recording. The last save waits until there is room."""
    monkeypatch.setattr(simulated_recording, "SAVE_EVERY", 0.0)
    path, disk = tmp_path / "record.safetensors", ExitStack()

    def make_room(seconds):
        assert not path.exists()
        disk.close()

    monkeypatch.setattr(patient_save, "time", SimpleNamespace(sleep=make_room, monotonic=time.monotonic))
    with disk:
        disk.enter_context(full_disk(100_000))
        data = simulated_recording.load_or_record(GROUND, path, 3, seed=1)
    assert Dataset.load(path).digest() == data.digest() and len(data.trajectories) == 5
    assert not path.with_name("record.part.safetensors").exists()
    printed = " ".join(capsys.readouterr().err.split())
    assert "is not saved: File too large" in printed and "is not saved yet: File too large. Make room" in printed


def test_a_disk_that_stays_full_ends_the_wait(monkeypatch, tmp_path):
    monkeypatch.setattr(patient_save, "RETRY", 0.01)
    monkeypatch.setattr(patient_save, "PATIENCE", 0.05)
    data = collect.dataset(GROUND, list(collect.record(GROUND, 1, 1, Conditions())), 1, Conditions())
    with full_disk(1000), pytest.raises(OSError, match="File too large"):
        patient_save.save_patiently(data, tmp_path / "record.safetensors")
    assert not list(tmp_path.iterdir())
