"""Test a robot that changes in mid-run: violations are counted, and a new model set from its own steps ends them."""

import json
import signal

from brakeline.logs.reader import open_log
from brakeline.messaging import brakeline_pb2 as pb
from tests.accepting import WORDS
from tests.system.runs import Run, brakeline
from tests.waiting import until

BEFORE, DURING, AFTER = 800, 4000, 600  # steps of both actors
ENDLESS = 100_000  # the run is ended when it has shown what is wanted, however long the new model set takes to make


def share(steps):
    compared = [step for step in steps if step.compared]
    return sum(not step.contained for step in compared) / len(compared)


def test_a_payload_is_noticed_and_a_new_model_set_takes_over_in_mid_run(data_folder, tmp_path):
    change = ("--change.after", BEFORE // 2, "--change.payload-kg", 2, "--practice", 0.15)
    with Run(tmp_path / "run", "--steps", ENDLESS, "--learner.td3.warmup", ENDLESS, *change, *WORDS) as run:
        metrics = run.watch()
        run.until_steps(BEFORE + DURING)
        words = ("--last", DURING - 400, "--certificates", "residual", "--mode", "direct", "--publish", "--json")
        certify = brakeline("certify", run.folder, *words, *WORDS, *run.there)
        assert certify.returncode == 0, certify.stderr
        published = json.loads(certify.stdout)["residual"]
        processes = metrics.processes
        until(lambda: processes["safety-0"].notes["model ground"] == published["version"], "the new model in use")
        run.until_steps(AFTER)
        figures = run.end(signal.SIGINT)
    assert figures["collisions"] == 0
    records = list(open_log(run.folder))
    models = [record.message.version for record in records if record.topic == "model"]
    assert models[-1] == published["version"]
    last = next(
        i for i, record in enumerate(records) if record.topic == "model" and record.message.version == models[-1]
    )
    taken = [(i, record.message) for i, record in enumerate(records) if isinstance(record.message, pb.Step)]
    recorded = [step for _, step in taken if step.index < BEFORE // 2]
    loaded = [step for i, step in taken if step.index > BEFORE // 2 and i < last]
    anew = [step for i, step in taken if i > last + 20]  # those on their way were decided on by the old one
    assert len(anew) > 400
    assert share(recorded) <= 0.01
    assert share(loaded) > 0.05, "the old model set does not know the payload"
    assert share(anew) <= published["bound_step"] < share(loaded), "the new one does, and states how well"
