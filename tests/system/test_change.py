"""Test a robot that changes in mid-run: violations are counted, and a new model set from its own steps ends them.

The new model set comes from `certify --publish` by hand, or from the certifier of `--adapt`.
"""

import json
import signal
from dataclasses import replace

import pytest

from brakeline.deploy.data.data_paths import record_path
from brakeline.logs.reader import open_log
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.model.dataset import Dataset
from tests.accepting import WORDS
from tests.robots import GROUND
from tests.system.runs import Run, succeeded
from tests.waiting import PATIENCE, until

DRIVEN = 1000  # steps of both actors
BEFORE, AFTER = 120, 1000
ENDLESS = 100_000  # the run is ended when it has shown what is wanted, however long the new model set takes to make


@pytest.mark.long  # each part is in a test of its own
def test_a_set_from_a_run_is_published_into_the_run_by_hand(data_folder, tmp_path):
    """That a set of a changed robot holds: the next test, and `tests/deploy/run/test_adaptation.py`."""
    practice = ("--learner.td3.warmup", ENDLESS, "--practice", 0.15)  # for the stops
    with Run(tmp_path / "run", "--steps", ENDLESS, *practice, *WORDS) as run:
        metrics = run.watch()
        run.until_steps(DRIVEN)
        words = ("--certificates", "residual", "--mode", "one-step", "--few", "--publish", "--json")
        certified = succeeded("certify", "--data", run.folder, "--last", DRIVEN, *words, *WORDS, *run.there)
        version = json.loads(certified)["residual"]["version"]
        until(lambda: metrics.processes["safety-0"].notes["model ground"] == version, "the new model in use")
        run.until_steps(100)
        figures = run.end(signal.SIGINT)
    assert figures["collisions"] == 0
    records = list(open_log(run.folder))
    assert [r.message.version for r in records if r.topic == "model"][-1] == version
    # A busy service may answer a question with an error, which is no decision.
    replies = [r.message.reply for r in records if isinstance(r.message, pb.Exchange)]
    decided = [reply.decision.model for reply in replies if reply.HasField("decision")]
    anew = decided[decided.index(version) + 20 :]  # an answer of before may be recorded after one of the other actor
    assert set(anew) == {version} and len(anew) > 50, "from then on, all are decided on by it"


def beyond(exchanges):
    """The share of windows outside their stated sets."""
    scores = [exchange.reply.decision.score for exchange in exchanges if exchange.reply.decision.HasField("score")]
    return sum(not score <= 1.0 for score in scores) / len(scores)


def test_the_certifier_of_a_run_publishes_a_set_of_the_changed_robot_by_itself(data_folder, tmp_path, monkeypatch):
    few = Dataset.load(record_path(GROUND))
    few = replace(few, trajectories=few.trajectories[:24])
    # A folder of its own: other tests' runs take the newest model set of the shared one.
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    record_path(GROUND).parent.mkdir(parents=True)
    few.save(record_path(GROUND))
    change = ("--change.after", BEFORE, "--change.payload-kg", 2)
    adapt = ("--actors", 1, "--mode", "one-step", "--adapt", "--learner.td3.warmup", ENDLESS)
    with Run(tmp_path / "run", "--steps", ENDLESS, *adapt, *change, *WORDS) as run:
        processes = run.watch().processes
        certifier = until(lambda: processes.get("certify.adapt"), "the certifier")
        until(lambda: certifier.figures.get("published ground"), "a new model set", 3.0 * PATIENCE)
        until(lambda: "after the change" in certifier.notes.get("adaptation ground", ""), "its note")
        note = certifier.notes["adaptation ground"]  # once it plans another set, its note says so
        run.until_steps(AFTER)
        refused = certifier.figures.get("refused ground", 0)
        figures = run.end(signal.SIGINT)
    version, why = note.split(" ", 1)
    assert "minutes after the change" in why and refused <= 1
    assert figures["collisions"] == 0 and "certify.adapt" not in figures["restarts"]
    records = list(open_log(run.folder))
    models = [record.message for record in records if record.topic == "model"]
    published = [model.version for model in models]
    assert published[0] == version and all(model.signature for model in models), "a later one may follow"
    exchanges = [record.message for record in records if isinstance(record.message, pb.Exchange)]
    old = [e for e in exchanges if e.request.widening > 1.3 and e.reply.decision.model not in published]
    new = [e for e in exchanges if e.reply.decision.model in published]
    assert len(new) > 900 and max(e.request.widening for e in new[-100:]) < max(e.request.widening for e in old)
    assert beyond(new) < 0.02 < beyond(old), "the new set knows the payload"
