"""What a process says while it lives and when it ends."""

import logging
import signal
import time
from typing import Any

import pytest

from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.topics import HEALTH, LOG
from tests.messaging.programs import Join, Spawn
from tests.waiting import until

PROCESS = """
from brakeline.messaging.bus import BusSettings
from brakeline.messaging.process_runtime import Process
with Process(BusSettings(connect=("{endpoint}",)), "worker") as process:
    process.figures["rate"] = 2.5
    process.announce()
    print("ready", flush=True)
    process.stop.wait(30.0)
    {end}
"""


def listen(bus: Bus) -> tuple[list[Any], list[Any]]:
    health: list[Any] = []
    lines: list[Any] = []
    bus.subscribe(HEALTH, lambda sample: health.append(sample.message()))
    bus.subscribe(LOG, lambda sample: lines.append(sample.message()))
    return health, lines


def wait_for_goodbye(health: list[Any]) -> Any:
    until(lambda: health and health[-1].last)
    return health[-1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_a_goodbye(join: Join, spawn: Spawn, endpoint: str, number: signal.Signals) -> None:
    health, lines = listen(join("launcher", listen=True))
    child = spawn(PROCESS.format(endpoint=endpoint, end=""))
    time.sleep(1.2)
    child.send_signal(number)
    last = wait_for_goodbye(health)
    assert child.wait(5.0) == 0
    assert len(health) >= 3, "one when announced, one a second, one at the end"
    assert last.figures["rate"] == 2.5
    assert last.published["health/worker"] == len(health) == last.header.sequence
    assert lines == []


def test_an_echo_of_the_signal_changes_nothing_and_a_second_one_kills(join: Join, spawn: Spawn, endpoint: str) -> None:
    health, _ = listen(join("launcher", listen=True))
    child = spawn(PROCESS.format(endpoint=endpoint, end="import time; time.sleep(30)"))
    for _ in range(5):
        child.terminate()
        time.sleep(0.02)
    time.sleep(1.2)
    assert child.poll() is None, "it ends in order"
    child.terminate()
    assert child.wait(5.0) == 128 + signal.SIGTERM
    assert not any(message.last for message in health)


def test_a_process_that_fails_is_not_silent(join: Join, spawn: Spawn, endpoint: str) -> None:
    health, lines = listen(join("launcher", listen=True))
    child = spawn(PROCESS.format(endpoint=endpoint, end="raise ZeroDivisionError('oh')"))
    child.terminate()
    assert "ZeroDivisionError: oh" in wait_for_goodbye(health).notes["died of"]
    assert child.wait(5.0) == 1
    assert [line.level for line in lines] == ["ERROR"]
    assert "Traceback" in lines[0].text


def test_what_is_logged_goes_out_on_the_bus(join: Join, endpoint: str) -> None:
    health, lines = listen(join("launcher", listen=True))
    log = logging.getLogger("somewhere")
    with Process(BusSettings(connect=(endpoint,)), "worker", stderr=False) as process:
        process.refresh = lambda: process.notes.update(model="v3")
        log.info("%d robots", 2)
        log.critical("bad")
        log.debug("not this")
    log.error("not this either: it has ended")
    assert wait_for_goodbye(health).notes["model"] == "v3"
    assert [(line.process, line.level, line.text) for line in lines] == [
        ("worker", "INFO", "2 robots"),
        ("worker", "ERROR", "bad"),
    ]


def test_a_refresh_that_fails_does_not_stop_the_signs_of_life(join: Join, endpoint: str) -> None:
    health, lines = listen(join("launcher", listen=True))

    def refresh() -> None:
        raise KeyError("lost")

    with Process(BusSettings(connect=(endpoint,)), "worker", stderr=False) as process:
        process.refresh = refresh
        process.announce()
        time.sleep(0.3)
        process.refresh = None
    wait_for_goodbye(health)
    assert "the Health was not published" in lines[0].text
