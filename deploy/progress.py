"""Says how far a piece of work is: a bar in a terminal; redirected, a line now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

FIRST = 2.0  # s without a word: what is done by then needs none
AGAIN = 10.0  # s between two lines
UNDER_WAY: list[threading.Event] = []  # that say lines, each within the one before: the last one speaks
T = TypeVar("T")

console = Console(stderr=True, highlight=False, soft_wrap=True)


class Advance(Protocol):
    """So much more is done; and what is being done, if that has changed."""

    def __call__(self, by: int = 1, what: str | None = None) -> None: ...


@contextmanager
def under_way(what: str, total: int | None = None) -> Iterator[Advance]:
    """Shows `what` until the block ends; `total`: how often it will be told to advance, None: nobody knows."""
    with _bar(what, total) if console.is_terminal else _lines(what, total) as advance:
        yield advance


def each(items: Iterable[T], what: str, total: int, done: int = 0) -> Iterator[T]:
    """The items, with a word of how many there were; `done` of the `total` are there already."""
    with under_way(what, total) as advance:
        advance(done)
        for item in items:
            advance()
            yield item


@contextmanager
def _bar(what: str, total: int | None) -> Iterator[Advance]:
    counted = (BarColumn(), MofNCompleteColumn(), Remaining()) if total is not None else (TimeElapsedColumn(),)
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), *counted
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=total)

        def advance(by: int = 1, what: str | None = None) -> None:
            progress.update(task, advance=by, description=what)

        yield advance


@contextmanager
def _lines(what: str, total: int | None) -> Iterator[Advance]:
    begun, ended = time.monotonic(), threading.Event()
    UNDER_WAY.append(ended)
    said, done = what, 0

    def advance(by: int = 1, what: str | None = None) -> None:
        nonlocal said, done
        said, done = what or said, done + by

    def talk() -> None:
        wait = FIRST
        while not ended.wait(wait):
            if UNDER_WAY[-1] is ended:
                console.print(line(said, done, total, time.monotonic() - begun), markup=False)
            wait = AGAIN

    talker = threading.Thread(target=talk, name="progress", daemon=True)
    talker.start()
    try:
        yield advance
    finally:
        ended.set()
        talker.join()
        UNDER_WAY.remove(ended)


def line(what: str, done: int, total: int | None, seconds: float) -> str:
    """What is under way, how far it is, and since when [s]."""
    counted = "" if total is None else f"{done} of {total}, "
    return f"{what}: {counted}{seconds:.0f} s so far"
