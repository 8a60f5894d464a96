"""Test `brakeline status`: it shows the figures and notes of each process, without the curves of the live page."""

import json
import threading

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
