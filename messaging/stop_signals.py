"""Turn SIGINT, SIGTERM and SIGHUP into an event, or SIGTERM and SIGHUP into the exception of Ctrl-C."""

from __future__ import annotations

import math
import os
import signal
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

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
    before = {number: signal.signal(number, lambda *_: None) for number in _handled(NUMBERS)}
    previous = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(receiver, stop, patient), name="signals", daemon=True).start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous)
        for number, handler in before.items():
            signal.signal(number, handler)
        sender.close()  # ends the thread


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM and SIGHUP within the block, with their number; only in the main thread.

    A program that they kill would lose what it has not stored, and leave its temporary files behind. Signals within
    `REPEAT_TIME` are one: `timeout` sends SIGTERM twice.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    latest = -math.inf

    def interrupt(number: int, _: FrameType | None) -> None:
        nonlocal latest
        before, latest = latest, time.monotonic()
        if latest - before > REPEAT_TIME:
            raise KeyboardInterrupt(number)

    handlers = {number: signal.signal(number, interrupt) for number in _handled((signal.SIGTERM, signal.SIGHUP))}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _handled(numbers: Iterable[signal.Signals]) -> list[signal.Signals]:
    """Return the signals without SIGHUP if this process ignores it, as below `nohup`."""
    return [one for one in numbers if one != signal.SIGHUP or signal.getsignal(one) != signal.SIG_IGN]


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
