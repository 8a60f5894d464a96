"""Compare the figures of `analyse` with a count of the raw messages by another reader."""

import csv
import json
from pathlib import Path

from brakeline.logs.reader import find
from tests.logs.sample_log import agree, counted, decoded
from tests.system.runs import brakeline


def test_analyse_agrees_with_a_count_by_another_reader_field_by_field(logged_run: Path) -> None:
    expected = counted(decoded(find(logged_run)))
    done = brakeline("analyse", logged_run, "--json", "--html", logged_run / "report.html")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    agree({name: figures[name] for name in expected}, expected)
    assert figures["steps"] > 1000 and figures["tube_half_width"]["max"] < 0.1
    assert 'data-figure="goals"' in (logged_run / "report.html").read_text()


def test_rows_of_runs_and_of_steps(logged_run: Path) -> None:
    figures = json.loads(brakeline("analyse", logged_run, "--json").stdout)
    (row,) = csv.DictReader(brakeline("analyse", logged_run, "--csv").stdout.splitlines())
    assert (row["run"], int(row["steps"]), int(row["collisions"])) == (logged_run.name, figures["steps"], 0)
    assert float(row["decision_ms.adjusted.p99"]) == figures["decision_ms"]["adjusted"]["p99"]
    words = ("analyse", logged_run, "--episode", 1, "--actor", "actor-0", "--csv")
    steps = list(csv.DictReader(brakeline(*words).stdout.splitlines()))
    assert [int(step["step"]) for step in steps] == list(range(len(steps))) and steps[0]["actor"] == "actor-0"
    decisions = {step["decision"] for step in steps}
    assert decisions <= {"allowed", "adjusted", "failsafe"} | ({"no decision"} if figures["fallbacks"] else set())
    assert "step" in brakeline("analyse", logged_run, "--episode", 1).stdout
    none = brakeline("analyse", logged_run, "--episode", 12345)
    assert none.returncode == 1 and "there is no episode 12345" in none.stderr
