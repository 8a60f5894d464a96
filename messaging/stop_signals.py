"""SIGINT and SIGTERM as an event that is set."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

ECHO = 1.0  # s; signals this close are one: the kernel tells of a parent's death once for each thread that it had
NUMBERS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_signals(stop: threading.Event, patient: bool = False) -> Iterator[threading.Event]:
    """Within the block SIGINT and SIGTERM set `stop`; a second one, later, ends the process at once with status
    128 + its number, unless `patient`. Does nothing but in the main thread.

    Python's own handlers can't set an event: they run in the main thread between any two of its instructions, and one
    that comes within `Event.wait` or `Event.set` waits for ever for the lock that it interrupted. Nor do they run at
    all while the main thread waits without a timeout and the kernel has handed the signal to another one. So a thread
    reads what the C handler writes, in whichever thread that ran.
    """
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    told, tell = socket.socketpair()
    tell.setblocking(False)
    before = {number: signal.signal(number, lambda *_: None) for number in NUMBERS}
    previous = signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(told, stop, patient), name="signals", daemon=True).start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous)
        for number, handler in before.items():
            signal.signal(number, handler)
        tell.close()  # and the thread ends


def _listen(told: socket.socket, stop: threading.Event, patient: bool) -> None:
    first: float | None = None
    with told:
        while received := told.recv(1):
            now = time.monotonic()
            first = now if first is None else first
            if received[0] in NUMBERS and now - first > ECHO and not patient:
                os._exit(128 + received[0])
            stop.set()
