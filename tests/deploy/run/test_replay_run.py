"""Test the replay: the same decisions, and each difference with its size, also where sums have another order."""

import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.deploy.commands.replay_command import ReplayCommand
from brakeline.deploy.data.data_paths import model_path, record_path
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.run.replay_run import APART, Difference, differences, replay
from brakeline.errors import BadModel, LogError
from brakeline.logs.reader import open_log
from brakeline.logs.recorder import entry
from brakeline.logs.segment import open_segment
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.topics import STEP
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.wire import decision_reply, request_of
from tests.deploy.drive import drive
from tests.robots import GROUND

STEPS = 150
LINE = 64  # bytes: the widest vector that a processor loads at once


def test_the_same_version_decides_the_same(log: Path, figures) -> None:
    same = figures("replay", log)
    assert (same["requests"], same["identical"] + same["equal"], same["different"]) == (STEPS, STEPS, 0)
    assert set(same["kinds"]) >= {"allowed", "adjusted"}, "the log has something to compare"
    assert same["fields"] == {} and same["examples"] == [] and same["same_input"] == STEPS


def test_a_log_suffices_for_a_replay_also_with_another_margin(log, tmp_path, monkeypatch, figures) -> None:
    """The model set in use on this machine is another one than that in the log."""
    margin = Filter(model_for(GROUND, ModelConfig())).clearance_margin
    shutil.copy(log, tmp_path / "elsewhere.mcap")
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "nothing"))
    for changes in ((), ("--margin", margin)):
        again = figures("replay", tmp_path / "elsewhere.mcap", *changes)
        assert again["identical"] + again["equal"] == STEPS, changes


def test_a_mode_alone_is_refused(log, command) -> None:
    status, _, err = command("replay", log, "--mode", "one-step")
    assert status == 1 and "give --certificate or --data too" in err


def test_a_log_without_models_is_replayed_from_its_folder_or_not_at_all(data_folder, tmp_path, monkeypatch) -> None:
    version = drive(tmp_path / "run.mcap", 20, attach=False)
    model = model_for(GROUND, ModelConfig())
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "nothing"))
    with pytest.raises(LogError, match=version):
        replay(tmp_path)
    model.save(tmp_path / "ground" / "models" / f"{version}.safetensors")
    again = replay(tmp_path)
    assert (again.requests, again.unanswered, again.different) == (20, 0, 0)


def test_another_margin_changes_decisions_by_stated_amounts(log: Path, figures) -> None:
    margin = Filter(model_for(GROUND, ModelConfig())).clearance_margin
    wider = figures("replay", log, "--margin", margin + 0.05)
    assert wider["different"] > 0 and wider["instead"] == {"margin": margin + 0.05}
    assert wider["fields"]["input"]["largest"] > 0.0
    assert wider["same_input"] == STEPS - wider["fields"]["input"]["count"] < STEPS
    changes = [example["differences"].get("input", 0.0) for example in wider["examples"]]
    assert changes == sorted(changes, reverse=True) and changes[0] == wider["fields"]["input"]["largest"]
    assert figures("replay", log, "--margin", margin)["different"] == 0


def test_another_error_bound_and_other_data_can_be_replayed(log, few_data, tmp_path, monkeypatch, figures) -> None:
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    record_path(GROUND).parent.mkdir()
    shutil.copy(few_data, record_path(GROUND))
    words = ("replay", log, "--certificate", "matrix-zonotope")
    wider = figures(*words)
    assert wider["different"] == STEPS and "model" not in wider["fields"]
    assert sum(count for row in wider["kinds"].values() for count in row.values()) == STEPS
    same = figures(*words, "--data", record_path(GROUND))
    assert same["kinds"] == wider["kinds"] and same["instead"]["data"] == str(record_path(GROUND))


def test_the_replay_of_an_old_log_replaces_no_model_set_and_no_data_in_use(few_data, tmp_path, monkeypatch) -> None:
    """Before, it fitted and recorded the robot of the log into the files that the other commands load."""
    model = model_for(GROUND, ModelConfig())
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    record, path = record_path(GROUND), model_path(GROUND, ModelConfig())
    record.parent.mkdir()
    shutil.copy(few_data, record)
    of_then = ReplayCommand(certificate="residual")._replacement()
    with pytest.raises(BadModel, match=r"before the description of ground changed .* Give data of this description"):
        of_then(replace(GROUND, period=0.25))
    model.save(path)
    before = {file: file.read_bytes() for file in record.parent.iterdir()}
    with pytest.raises(BadModel, match=r"residual-direct.safetensors is of another description of ground"):
        of_then(replace(GROUND, sight=GROUND.sight + 1.0))
    assert {file: file.read_bytes() for file in record.parent.iterdir()} == before
    assert of_then(GROUND).version == model.version


def test_requests_older_than_known_free_keep_their_meaning(data_folder: Path, tmp_path: Path) -> None:
    ask = in_process(model_for(GROUND, ModelConfig()))

    def before(exchange: pb.Exchange) -> None:
        request = exchange.request
        del request.obstacles[:]
        request.known_free = request.step < 8  # the later ones are refused for saying nothing
        exchange.reply.CopyFrom(ask([request])[0])
        request.known_free = False

    drive(tmp_path / "run.mcap", 10, before)
    replayed = replay(tmp_path)
    assert (replayed.requests, replayed.identical) == (10, 10)
    assert replayed.kinds["error", "error"] == 2 and replayed.kinds.total() == 10


def test_falsified_decisions_are_found(data_folder: Path, tmp_path: Path, command) -> None:
    def falsify(exchange: pb.Exchange) -> None:
        decision = exchange.reply.decision
        if exchange.request.step == 1:
            decision.plan[0] += 1e-14
            decision.iterations += 7
        if exchange.request.step == 3:
            decision.plan[0] += 1e-11
        if exchange.request.step == 5:
            decision.kind = pb.FAILSAFE
        if exchange.request.step == 7:
            exchange.ClearField("reply")
        if exchange.request.step == 9:
            exchange.reply.error.type = "BadRequest"
        decision.time_ms += 1.0

    drive(tmp_path / "run.mcap", 12, falsify)
    status, out, _ = command("replay", tmp_path, "--json")
    figures = json.loads(out)
    assert status == 1
    assert (figures["requests"], figures["unanswered"], figures["different"]) == (12, 1, 3)
    assert figures["identical"] + figures["equal"] == 8 and figures["equal"] >= 1
    assert figures["rounding"] == pytest.approx(1e-14, rel=0.1, abs=0.0) and figures["same_input"] == 9
    assert figures["fields"]["input"] == {"count": 1, "largest": pytest.approx(1e-11, rel=1e-3)}
    assert figures["fields"]["kind"]["count"] == 1 and figures["fields"]["result"]["count"] == 1
    assert {example["step"] for example in figures["examples"]} == {3, 5, 9}
    status, shown, _ = command("replay", tmp_path)
    assert status == 1 and "11 requests; 1 had no answer" in shown and "different: 3" in shown


def test_a_replay_says_what_it_could_not_read(damaged: Path, tmp_path: Path, command) -> None:
    status, out, err = command("replay", damaged, "--json")
    figures = json.loads(out)
    assert status == 0 and figures["requests"] == STEPS - 1
    assert len(figures["cuts"]) == 2 and all(cut in err for cut in figures["cuts"])
    (tmp_path / "empty.mcap").touch()
    status, _, err = command("replay", tmp_path / "empty.mcap")
    assert status == 1 and "no request could be read" in err


def test_a_replay_says_that_the_log_of_a_batch_holds_no_requests(tmp_path: Path, command) -> None:
    segment = open_segment(tmp_path / "run.mcap", {"run": {"method": "ddpc"}}, None)
    step = pb.Step(header=pb.Header(sequence=1, source="actor-0", run=1, wall_time=1), robot="ground", actor="actor-0")
    key = STEP.at(robot="ground", source="actor-0")
    segment.save([entry(Sample(STEP, key, step.SerializeToString(), 1))])
    segment.finish()
    status, _, err = command("replay", tmp_path)
    assert status == 1 and "the log of a batch holds steps, but no requests" in err


def test_a_replay_says_which_requests_of_a_fleet_it_could_not_decide_again(data_folder: Path, tmp_path: Path) -> None:
    """Those of the other robots are not in the log, or were sent by another start of the process."""

    def together(exchange: pb.Exchange) -> None:
        if exchange.request.step < 3:
            exchange.request.fleet[:] = ["actor-0", "actor-1"]

    drive(tmp_path / "a" / "run.mcap", 8, together)
    drive(tmp_path / "b" / "run.mcap", 8, together, actor="actor-1", run=2)
    replayed = replay([tmp_path / "a", tmp_path / "b"])
    assert (replayed.requests, replayed.different) == (10, 0)
    assert any("6 requests of a fleet are not compared" in line for line in replayed.damage.lines)


def test_a_log_that_begins_after_a_change_of_models_has_no_stale_models(data_folder: Path, tmp_path: Path) -> None:
    def verified_before(exchange: pb.Exchange) -> None:
        if exchange.request.model:
            exchange.request.model = "0123456789ab"

    drive(tmp_path / "run.mcap", 30, verified_before)
    figures = replay(tmp_path).figures()
    assert figures["requests"] == 30 and "result" not in figures["fields"]
    assert not any("error" in now for now in figures["kinds"].values())


def test_differences_of_replies() -> None:
    one = pb.Reply(decision=pb.Decision(plan=(1.0, 2.0, 0.0, 0.0), reason="a", time_ms=1.0))
    other = pb.Reply(decision=pb.Decision(plan=(1.0, 2.5, 0.0, 0.0), reason="b", time_ms=9.0))
    assert differences(one, one, 2) == {}
    half = Difference(0.5, rounding=False)
    assert differences(one, other, 2) == {"plan": half, "input": half}, "a later version may word the reason otherwise"
    shorter = pb.Reply(decision=pb.Decision(plan=(1.0, 2.0), reason="a"))
    assert differences(one, shorter, 2) == {"plan": APART}
    error = pb.Reply(error=pb.Error(type="StaleModel", message="x"))
    assert differences(one, error, 2) == {"result": APART}
    assert differences(error, pb.Reply(error=pb.Error(type="StaleModel", message="y")), 2) == {}
    assert differences(error, pb.Reply(error=pb.Error(type="NoModel")), 2) == {"error": APART}


def test_rounding_is_relative_to_the_number_or_to_one() -> None:
    def off(value: float, by: float) -> bool:
        one, other = (pb.Reply(decision=pb.Decision(margin=m)) for m in (value, value + by))
        return differences(one, other, 2)["margin"].rounding

    assert off(0.1, 1e-13) and off(5000.0, 4e-9)
    assert not off(0.1, 2e-12) and not off(5000.0, 6e-9) and not off(0.1, math.inf) and not off(0.1, math.nan)


def test_a_field_that_an_older_log_lacks_is_no_difference() -> None:
    before, now = pb.Decision(kind=pb.ADJUSTED), pb.Decision(kind=pb.ADJUSTED, for_clearance=True)
    assert differences(pb.Reply(decision=before), pb.Reply(decision=now), 2) == {}
    now.for_clearance = before.for_clearance = False
    before.for_clearance = True
    assert differences(pb.Reply(decision=before), pb.Reply(decision=now), 2) == {"for_clearance": APART}


# --- sums in another order: the same kinds, and numbers equal to within rounding ------------------------------------


def test_with_another_processors_linear_algebra_no_decision_differs(log: Path) -> None:
    """The kernels of a processor without wide vectors, where there is a choice (x86), add in another order."""
    words = (sys.executable, "-m", "brakeline.deploy.cli", "replay", str(log), "--json")
    done = subprocess.run(
        words, env=os.environ | {"OPENBLAS_CORETYPE": "Prescott"}, capture_output=True, text=True, check=False
    )
    figures = json.loads(done.stdout)
    assert (done.returncode, figures["different"]) == (0, 0), figures
    assert figures["identical"] + figures["equal"] == figures["requests"] > 0
    assert figures["rounding"] < 1e-12


def moved(array: Any, offset: int) -> Any:
    """A copy of an array that begins so many bytes after a cache line, as a view into a larger buffer."""
    buffer = np.empty(array.nbytes + 2 * LINE, np.uint8)
    start = -buffer.ctypes.data % LINE + offset
    view = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    view[...] = array
    return view


def owners(thing: object, seen: set[int]) -> Iterator[dict[str, Any]]:
    """The attributes of an object of ours and of all that it holds."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, tuple | list):
        for part in thing:
            yield from owners(part, seen)
    elif type(thing).__module__.startswith("brakeline.safety") and hasattr(thing, "__dict__"):
        yield vars(thing)
        for part in list(vars(thing).values()):
            yield from owners(part, seen)


def move_arrays(thing: object, offset: int) -> int:
    """Move every array of floats that an object holds; how many there were."""

    def one(value: Any) -> Any:
        nonlocal count
        if isinstance(value, np.ndarray) and value.dtype == float and value.size and value.flags.c_contiguous:
            count += 1
            return moved(value, offset)
        return tuple(map(one, value)) if type(value) is tuple else value

    count = 0
    for attributes in owners(thing, set()):
        attributes.update({name: one(value) for name, value in attributes.items()})
    return count


@pytest.mark.parametrize("offset", (8, 16, 40))
def test_with_another_alignment_of_arrays_no_decision_differs(log: Path, offset: int) -> None:
    ready, elsewhere = (Filter(model_for(GROUND, ModelConfig())) for _ in range(2))
    assert move_arrays(elsewhere, offset) > 30
    assert elsewhere.tube.W.ctypes.data % LINE == offset
    kinds = set()
    for record in open_log(log):
        if record.topic != "exchange":
            continue
        one, other = (request_of(record.message.request, GROUND) for _ in range(2))
        for name in ("state", "action", "input_in_force", "plan"):
            object.__setattr__(other, name, moved(getattr(other, name), offset))
        reply, again = decision_reply(ready.decide(one), 0.0), decision_reply(elsewhere.decide(other), 0.0)
        kinds.add(pb.Kind.Name(reply.decision.kind))
        different = differences(reply, again, GROUND.action_dim)
        assert all(difference.rounding for difference in different.values()), different
    assert kinds >= {"ALLOWED", "ADJUSTED"}


# --- questions that were logged before robots were files: the same is decided ---------------------------------------
# Since then distances to far walls are worked out with less rounding, the margin that is told is the true one, and QPs
# are solved exactly. The solver of that time was off by up to 1e-5 of an input's range where it converged. Where it did
# not, it found no input for the quadrotor that could be verified.

STORED = Path(__file__).parents[2] / "stored"


@pytest.mark.fast
def test_the_ground_robots_stored_requests_are_decided_as_before():
    result = replay(STORED / "ground-before-files.mcap")
    assert (result.requests, result.unanswered) == (400, 0)
    assert result.figures()["kinds"] == {"adjusted": {"adjusted": 171}, "allowed": {"allowed": 229}}
    assert max(result.fields["input"]) < 1e-5 and max(result.fields["plan"]) < 1e-5
    assert np.median(result.fields["input"]) < 1e-6


@pytest.mark.fast
def test_the_quadrotors_stored_requests_brake_no_more_often_than_before():
    result = replay(STORED / "quadrotor-before-files.mcap")
    assert (result.requests, result.unanswered) == (250, 0)
    kinds = result.figures()["kinds"]
    # Of the proposals once adjusted for clearance, the filter now allows those that come near only on their way.
    assert kinds["adjusted"] == {"adjusted": 122, "allowed": 4} and kinds["allowed"] == {"allowed": 102}
    assert kinds["failsafe"]["adjusted"] > 0 and sum(kinds["failsafe"].values()) == 22
