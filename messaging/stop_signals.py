"""Turn SIGINT, SIGTERM and SIGHUP into an event."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

REPEAT_TIME = 0.5  # signals within this time are one [s]: the kernel repeats it for each thread of a dead parent
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def stop_on_signals(stop: threading.Event, patient: bool = False) -> Iterator[threading.Event]:
    """Set `stop` on SIGINT, SIGTERM and SIGHUP (a terminal was closed) within the block; only in the main thread.

    A second signal more than `REPEAT_TIME` later ends the process at once, with status 128 + its number, unless
    `patient`.

    Python's own signal handlers cannot set an event safely: they run in the main thread between two instructions, and
    within `Event.wait` or `Event.set` a handler would deadlock on the event's lock. They also do not run while the main
    thread waits without a timeout and another thread received the signal. Therefore a thread reads the bytes that the C
    handler writes to the wakeup socket.
    """
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    # `nohup` has SIGHUP ignored.
    numbers = [one for one in NUMBERS if one != signal.SIGHUP or signal.getsignal(one) != signal.SIG_IGN]
    before = {number: signal.signal(number, lambda *_: None) for number in numbers}
    previous = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(receiver, stop, patient), name="signals", daemon=True).start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous)
        for number, handler in before.items():
            signal.signal(number, handler)
        sender.close()  # ends the thread


def _listen(receiver: socket.socket, stop: threading.Event, patient: bool) -> None:
    first: float | None = None
    with receiver:
        while received := receiver.recv(4096):  # a volley at once
            now = time.monotonic()
            first = now if first is None else first
            number = next((one for one in received if one in NUMBERS), None)
            if number is not None and now - first > REPEAT_TIME and not patient:
                os._exit(128 + number)
            stop.set()
