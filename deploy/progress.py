"""Show the progress of work: as a bar in a terminal, else as a line now and then."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining
from rich.text import Text

FIRST = 2.0  # s until the first line; shorter work prints none
AGAIN = 10.0  # s between two lines
PERCENT = 100  # items of one piece of work, of which only the share that is done is known
UNDER_WAY: list[threading.Event] = []  # nested work that prints lines; only the innermost prints
PRINTING = threading.Lock()  # outer work must not print after inner work has begun

console = Console(stderr=True, highlight=False, soft_wrap=True)


class Advance(Protocol):
    """Report that `by` more items are done, and optionally what is being done now."""

    def __call__(self, by: int = 1, what: str | None = None) -> None: ...


def by_share(advance: Advance) -> Callable[[float], None]:
    """Return a function that advances to a share of one piece of work, in `PERCENT` items. It never goes back."""
    done = 0

    def progress(share: float) -> None:
        nonlocal done
        now = max(int(PERCENT * share), done)
        advance(now - done)
        done = now

    return progress


def say(name: str, text: str) -> None:
    """Print the progress of a part of a study."""
    console.print(Text.assemble((f"{name}:", "dim"), " ", text))


@contextmanager
def silenced() -> Iterator[None]:
    """Show no progress within the block."""
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = False


@contextmanager
def errors_only(name: str) -> Iterator[None]:
    """Let a logger pass errors alone until the block ends."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextmanager
def under_way(what: str, total: int | None = None) -> Iterator[Advance]:
    """Show `what` until the block ends. total: number of items; None if it is unknown."""
    with _bar(what, total) if console.is_terminal else _lines(what, total) as advance:
        yield advance


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
    start, ended = time.monotonic(), threading.Event()
    with PRINTING:
        UNDER_WAY.append(ended)
    current, done = what, 0

    def advance(by: int = 1, what: str | None = None) -> None:
        nonlocal current, done
        current, done = what or current, done + by

    def print_lines() -> None:
        wait = FIRST
        while not ended.wait(wait):
            with PRINTING:
                if UNDER_WAY[-1] is ended:
                    console.print(line(current, done, total, time.monotonic() - start), markup=False)
            wait = AGAIN

    printer = threading.Thread(target=print_lines, name="progress", daemon=True)
    printer.start()
    try:
        yield advance
    finally:
        ended.set()
        printer.join()
        UNDER_WAY.remove(ended)


def line(what: str, done: int, total: int | None, seconds: float) -> str:
    """Return a line of progress. seconds: time since the start [s]."""
    counted = "" if total is None else f"{done} of {total}, "
    return f"{what}: {counted}{seconds:.0f} s so far"
