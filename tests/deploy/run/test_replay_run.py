"""Test the replay: the same decisions, and each difference with its size."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from brakeline.deploy import cli
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.run.replay_run import APART, Difference, differences, replay
from brakeline.errors import LogError
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.model_set import ModelConfig
from tests.deploy.drive import drive
from tests.robots import GROUND

STEPS = 150


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Any]]:
    status = cli.main([*map(str, words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_the_same_version_decides_the_same(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, figures = run(capsys, "replay", log)
    assert status == 0
    assert (figures["requests"], figures["identical"] + figures["equal"], figures["different"]) == (STEPS, STEPS, 0)
    assert set(figures["kinds"]) >= {"allowed", "adjusted"}, "the log has something to compare"
    assert figures["fields"] == {} and figures["examples"] == [] and figures["same_input"] == STEPS


def test_a_log_suffices_for_a_replay(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(log, tmp_path / "elsewhere.mcap")
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "nothing"))
    status, figures = run(capsys, "replay", tmp_path / "elsewhere.mcap")
    assert (status, figures["identical"] + figures["equal"]) == (0, STEPS)


def test_a_log_without_models_is_replayed_from_its_folder_or_not_at_all(
    data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    version = drive(tmp_path / "run.mcap", 20, attach=False)
    model = model_for(GROUND, ModelConfig())
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "nothing"))
    with pytest.raises(LogError, match=version):
        replay(tmp_path)
    model.save(tmp_path / "ground" / "models" / f"{version}.safetensors")
    again = replay(tmp_path)
    assert (again.requests, again.unanswered, again.different) == (20, 0, 0)


def test_another_margin_changes_decisions_by_stated_amounts(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    margin = Filter(model_for(GROUND, ModelConfig())).clearance_margin
    status, figures = run(capsys, "replay", log, "--margin", margin + 0.05)
    assert status == 0, "it was asked for"
    assert figures["different"] > 0 and figures["instead"] == {"margin": margin + 0.05}
    assert figures["fields"]["input"]["largest"] > 0.0
    assert figures["same_input"] == STEPS - figures["fields"]["input"]["count"] < STEPS
    changes = [example["differences"].get("input", 0.0) for example in figures["examples"]]
    assert changes == sorted(changes, reverse=True) and changes[0] == figures["fields"]["input"]["largest"]
    assert run(capsys, "replay", log, "--margin", margin)[1]["different"] == 0


def test_another_error_bound_and_other_data_can_be_replayed(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("replay", log, "--certificate", "set-membership")
    _, wider = run(capsys, *words)
    assert wider["different"] == STEPS and "model" not in wider["fields"]
    assert sum(count for row in wider["kinds"].values() for count in row.values()) == STEPS
    _, same = run(capsys, *words, "--data", record_path(GROUND))
    assert same["kinds"] == wider["kinds"] and same["instead"]["data"] == str(record_path(GROUND))


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


def test_falsified_decisions_are_found(data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    status, figures = run(capsys, "replay", tmp_path)
    assert status == 1
    assert (figures["requests"], figures["unanswered"], figures["different"]) == (12, 1, 3)
    assert figures["identical"] + figures["equal"] == 8 and figures["equal"] >= 1
    assert figures["rounding"] == pytest.approx(1e-14, rel=0.1, abs=0.0) and figures["same_input"] == 9
    assert figures["fields"]["input"] == {"count": 1, "largest": pytest.approx(1e-11, rel=1e-3)}
    assert figures["fields"]["kind"]["count"] == 1 and figures["fields"]["result"]["count"] == 1
    assert {example["step"] for example in figures["examples"]} == {3, 5, 9}
    assert cli.main(["replay", str(tmp_path)]) == 1
    shown = capsys.readouterr().out
    assert "11 requests; 1 had no answer" in shown and "different: 3" in shown


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
    assert differences(one, other, 2) == {"plan": half, "reason": APART, "input": half}
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
