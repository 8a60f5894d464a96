"""Test your own robot by commands alone, from a CSV file of a drive to decisions of the service."""

import json
import subprocess

from brakeline.messaging.free_ports import free_endpoint
from tests.accepting import WORDS
from tests.deploy.data.porter import FILE, drive, porter, write_csv
from tests.system.runs import BRAKELINE, brakeline, succeeded
from tests.waiting import until


def figures(*words):
    return json.loads(succeeded(*words, "--json"))


def test_four_commands_from_a_csv_to_an_answer(tmp_path, monkeypatch):
    """That a filter from such a log lets nobody hit anything: `tests/examples/test_own_log.py`."""
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    imported = figures("import", write_csv(tmp_path / "drive.csv", *drive()), "--robot", FILE)
    made = figures("certify", FILE, "--use", *WORDS, "--certificates", "residual", "--mode", "direct")
    assert imported["coverage"]["stops"] > 100 and not imported["refused"]
    assert made["residual"]["windows_of"] == "free", "nobody followed the ramp"
    assert "rank" in made["residual"]["not_of"]["plan"]
    endpoint = free_endpoint()
    with (tmp_path / "safety.err").open("w") as err:
        service = subprocess.Popen(
            [*BRAKELINE, "safety", str(FILE), "--listen", endpoint, *map(str, WORDS)], stderr=err, stdout=err
        )
        try:
            words = ("--connect", endpoint, "--obstacle", "cylinder 0.5 0 0.1", "--timeout", 5, "--json")

            def answered():
                assert service.poll() is None, (tmp_path / "safety.err").read_text()
                query = brakeline("query", FILE, "--action", 0.6, 0, *words)
                return json.loads(query.stdout) if query.returncode == 0 else None

            answer = until(answered, "an answer")
        finally:
            service.terminate()
            service.wait()
    assert answer["kind"] == "adjusted" and len(answer["plan"]) == porter().horizon
    assert 0.0 <= answer["plan"][0][0] < 0.6 and answer["margin"] >= 0.0
