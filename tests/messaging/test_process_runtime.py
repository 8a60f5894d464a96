"""What a process says while it lives and when it ends. Signals that come in a volley, at any moment, to whichever
thread, set the event, and nobody waits for ever.
"""

import logging
import signal
import subprocess
import threading
import time
from typing import Any

import pytest

from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.stop_signals import NUMBERS, stop_on_signals
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
    until(lambda: len(health) >= 2, "one when announced, one a second")
    child.send_signal(number)
    last = wait_for_goodbye(health)
    assert child.wait(5.0) == 0
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
    until(lambda: len(lines) >= 2)  # another thread delivers them
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


WAITS = """
import signal
import threading
from brakeline.messaging.stop_signals import stop_on_signals
signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the rest of a volley comes when it is through
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
with stop_on_signals(threading.Event()) as stop:
    print("ready", flush=True)
    {wait}
print("ended", flush=True)
"""


def ended(process: "subprocess.Popen[str]") -> None:
    output, _ = process.communicate(timeout=20.0)
    assert (process.returncode, output) == (0, "ended\n")


def test_a_volley_that_comes_while_it_waits_again_and_again(spawn: Spawn) -> None:
    """Python's handler would come within `Event.wait`, and wait for the lock that `wait` holds."""
    process = spawn(WAITS.format(wait="while not stop.wait(1e-6): pass"))
    for _ in range(300):
        process.send_signal(signal.SIGTERM)
    ended(process)


def test_a_signal_that_another_thread_was_handed(spawn: Spawn) -> None:
    """The main thread, asleep without a timeout, would never hear of it."""
    hand_over = "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})"
    other = "threading.Thread(target=threading.Event().wait, daemon=True).start()"
    process = spawn(WAITS.format(wait=f"import signal; {other}; {hand_over}; stop.wait()"))
    process.send_signal(signal.SIGTERM)
    ended(process)


def test_a_closed_terminal_ends_a_process_in_order_but_not_under_nohup(spawn: Spawn) -> None:
    process = spawn(WAITS.format(wait="stop.wait()"))
    process.send_signal(signal.SIGHUP)
    ended(process)
    with stop_on_signals(threading.Event()) as stop:
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            with stop_on_signals(threading.Event()):
                signal.raise_signal(signal.SIGHUP)
                assert not stop.wait(0.2)
        finally:
            signal.signal(signal.SIGHUP, before)


def test_the_handlers_are_restored_and_another_thread_changes_none() -> None:
    before = [signal.getsignal(number) for number in NUMBERS]
    with stop_on_signals(threading.Event()) as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.wait(10.0)
    assert [signal.getsignal(number) for number in NUMBERS] == before
    seen = []

    def elsewhere() -> None:
        with stop_on_signals(threading.Event()):
            seen.extend(signal.getsignal(number) for number in NUMBERS)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == before


INTERRUPTED = """
import signal, time
from brakeline.messaging.stop_signals import interrupt_on_signals
signal.signal(signal.SIGHUP, signal.{hangup})  # the tests may run under nohup
with interrupt_on_signals():
    try:
        print("ready", flush=True)
        time.sleep({seconds})
    except KeyboardInterrupt as error:
        time.sleep(0.3)  # while it stores a file
        print("stored", error, flush=True)
"""


def test_sigterm_interrupts_as_ctrl_c_does_and_its_echo_changes_nothing(spawn: Spawn) -> None:
    process = spawn(INTERRUPTED.format(hangup="SIG_DFL", seconds=30))
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=20.0)
    assert (process.returncode, output) == (0, f"stored {signal.SIGTERM:d}\n")


def test_a_closed_terminal_interrupts_but_not_under_nohup(spawn: Spawn) -> None:
    process = spawn(INTERRUPTED.format(hangup="SIG_DFL", seconds=30))
    process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=20.0)[0] == f"stored {signal.SIGHUP:d}\n"
    process = spawn(INTERRUPTED.format(hangup="SIG_IGN", seconds=0.5))
    process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=20.0)[0] == "" and process.returncode == 0
