"""Test a robot that changes in mid-run: violations are counted, and a new model set from its own steps ends them.

The new model set comes from `certify --publish` by hand, or from the certifier of `--adapt`.
"""

import json
import shutil
import signal

from scipy.stats import binomtest

from brakeline.logs.reader import open_log
from brakeline.messaging import brakeline_pb2 as pb
from tests.accepting import WORDS
from tests.system.runs import Run, brakeline
from tests.waiting import until

BEFORE, DURING, AFTER = 800, 2400, 600  # steps of both actors
ENDLESS = 100_000  # the run is ended when it has shown what is wanted, however long the new model set takes to make


def share(steps):
    violations, compared = counted(steps)
    return violations / compared


def counted(steps):
    """The violations, and the steps that were compared with their sets."""
    contained = [step.contained for step in steps if step.compared]
    return len(contained) - sum(contained), len(contained)


def test_a_payload_is_noticed_and_a_new_model_set_takes_over_in_mid_run(data_folder, tmp_path):
    change = ("--change.after", BEFORE // 2, "--change.payload-kg", 2, "--practice", 0.15)
    with Run(tmp_path / "run", "--steps", ENDLESS, "--learner.td3.warmup", ENDLESS, *change, *WORDS) as run:
        metrics = run.watch()
        run.until_steps(BEFORE + DURING)
        # A few episodes meet a few motors and floors only, so the sets are widened until they hold.
        words = ("--last", DURING - 400, "--certificates", "residual", "--mode", "direct", "--until-held")
        certify = brakeline("certify", "--data", run.folder, *words, "--publish", "--json", *WORDS, *run.there)
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
    assert published["bound_step"] < share(loaded), "the new one does"
    # The bound holds for the share, not for what is counted in a few hundred steps.
    assert binomtest(*counted(anew), published["bound_step"], "greater").pvalue > 1e-3, "and states how well"


def beyond(exchanges):
    """The share of windows outside their stated sets."""
    scores = [exchange.reply.decision.score for exchange in exchanges if exchange.reply.decision.HasField("score")]
    return sum(not score <= 1.0 for score in scores) / len(scores)


def test_the_certifier_of_a_run_publishes_a_set_of_the_changed_robot_by_itself(data_folder, tmp_path, monkeypatch):
    shutil.copytree(data_folder, tmp_path / "data")  # other tests' runs take the newest model set of the shared folder
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    change = ("--change.after", BEFORE // 4, "--change.payload-kg", 2)
    adapt = ("--actors", 1, "--mode", "one-step", "--adapt", "--learner.td3.warmup", ENDLESS)
    with Run(tmp_path / "run", "--steps", ENDLESS, *adapt, *change, *WORDS) as run:
        processes = run.watch().processes
        certifier = until(lambda: processes.get("certify.adapt"), "the certifier")
        run.until_steps(BEFORE + DURING // 2)
        until(lambda: certifier.figures.get("published ground"), "a new model set")
        run.until_steps(AFTER)
        note, refused = certifier.notes["adaptation ground"], certifier.figures.get("refused ground", 0)
        figures = run.end(signal.SIGINT)
    version, why = note.split(" ", 1)
    assert "minutes after the change" in why and refused <= 1
    assert figures["collisions"] == 0 and "certify.adapt" not in figures["restarts"]
    records = list(open_log(run.folder))
    models = [record.message for record in records if record.topic == "model"]
    assert [model.version for model in models] == [version] and models[0].signature
    exchanges = [record.message for record in records if isinstance(record.message, pb.Exchange)]
    old = [e for e in exchanges if e.request.widening > 1.3 and e.reply.decision.model != version]
    new = [e for e in exchanges if e.reply.decision.model == version]
    assert len(new) > 200 and max(e.request.widening for e in new[-100:]) < max(e.request.widening for e in old)
    assert beyond(new) < 0.02 < beyond(old), "the new set knows the payload"
