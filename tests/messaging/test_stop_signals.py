"""Signals that come in a volley, at any moment, to whichever thread: the event is set, and nobody waits for ever."""

import signal
import subprocess
import sys
import threading

from brakeline.messaging.stop_signals import NUMBERS, stop_on_signals

WAITS = """
import signal
import threading
from brakeline.messaging.stop_signals import stop_on_signals
signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the rest of a volley comes when it is through
print("born", flush=True)
with stop_on_signals(threading.Event()) as stop:
    print("ready", flush=True)
    {wait}
print("ended", flush=True)
"""


def child(wait: str) -> "subprocess.Popen[str]":
    started = subprocess.Popen([sys.executable, "-c", WAITS.format(wait=wait)], stdout=subprocess.PIPE, text=True)
    assert started.stdout is not None
    assert [started.stdout.readline() for _ in range(2)] == ["born\n", "ready\n"]
    return started


def ended(process: "subprocess.Popen[str]") -> None:
    output, _ = process.communicate(timeout=20.0)
    assert (process.returncode, output) == (0, "ended\n")


def test_a_volley_that_comes_while_it_waits_again_and_again() -> None:
    """Python's handler would come within `Event.wait`, and wait for the lock that `wait` holds."""
    process = child("while not stop.wait(1e-6): pass")
    for _ in range(300):
        process.send_signal(signal.SIGTERM)
    ended(process)


def test_a_signal_that_another_thread_was_handed() -> None:
    """The main thread, asleep without a timeout, would never hear of it."""
    hand_over = "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})"
    other = "threading.Thread(target=threading.Event().wait, daemon=True).start()"
    process = child(f"import signal; {other}; {hand_over}; stop.wait()")
    process.send_signal(signal.SIGTERM)
    ended(process)


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
