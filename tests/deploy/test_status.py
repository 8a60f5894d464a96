"""Test `brakeline status`: it shows the figures and notes of each process, without the curves of the live page."""

import json
import threading

import pytest

from brakeline.deploy.run.processes import write_endpoint
from brakeline.logs.watch.run_history import NOTE
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import HEALTH


def test_the_table_and_the_json_leave_out_the_curves_of_the_live_page(command, figures) -> None:
    endpoint, ended = free_endpoint(), threading.Event()
    notes = {"run": "first", NOTE: json.dumps({"ground": [[93, 0, 0, 0, 12, 0]] * 40})}
    with Bus(BusSettings(listen=(endpoint,)), "launcher") as bus:

        def publish() -> None:
            publisher = bus.publisher(HEALTH)
            while not ended.wait(0.2):
                publisher.put(pb.Health(process="launcher", pid=7, notes=notes))

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            status, table, _ = command("status", "--connect", endpoint)
            shown = figures("status", "--connect", endpoint)
        finally:
            ended.set()
            thread.join()
    assert status == 0 and "pid 7, run first" in table
    assert max(map(len, table.splitlines())) < 100
    assert shown["processes"]["launcher"] == {"pid": 7, "run": "first"}


@pytest.mark.parametrize("words", ["status", "query ground --known-free", "watch --port 0"])
def test_a_run_that_has_ended_is_named_at_once(command, tmp_path, monkeypatch, words) -> None:
    """Before, the error after ten seconds named an endpoint that nobody had given."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "first"
    run.mkdir(parents=True)
    write_endpoint(run, BusSettings(listen=(free_endpoint(),)))
    (run.parent / "latest").symlink_to(run.name)
    status, out, err = command(*words.split())
    assert (status, out) == (1, "") and "the run at runs/latest (first) has ended: give --connect" in err


@pytest.mark.parametrize("text", ["", "3", "[]", "{}", '{"endpoint": 3}', '{"endpoint": "tls/127.0.0.1'])
def test_a_damaged_file_of_the_newest_run_names_no_run(command, tmp_path, monkeypatch, text) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "latest").mkdir(parents=True)
    (tmp_path / "runs" / "latest" / "endpoint").write_text(text)
    status, out, err = command("status")
    assert (status, out) == (1, "") and "no run at runs/latest: give --connect" in err
