"""What a comparison has to find out, two at once, resuming from what is there.

Nothing heavy here: a worker imports what its job needs."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from brakeline.deploy.interpreter import spawning
from brakeline.messaging.atomic_files import write_atomically

LONGEST_LINE = 500  # characters of a job's progress


class StaleResultError(ValueError):
    """A result that is there was made with other settings."""


class Job(Protocol):
    """Something to find out: its place among the results, what it depends on, and how."""

    @property
    def robot(self) -> str: ...
    @property
    def name(self) -> str: ...
    def config(self) -> dict[str, Any]: ...
    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]: ...


def result_path(results: Path, job: Job) -> Path:
    return results / job.robot / f"{job.name}.json"


def read(results: Path, job: Job) -> dict[str, Any] | None:
    """The job's result, None if it has none yet.

    Raises:
        StaleResultError: it has one of other settings; the message names them.
    """
    path = result_path(results, job)
    if not path.exists():
        return None
    found: dict[str, Any] = json.loads(path.read_text())
    theirs, ours = found.get("study", {}), job.config()
    differing = sorted(name for name in theirs | ours if theirs.get(name) != ours.get(name))
    if differing:
        raise StaleResultError(f"{path} was made with another {', '.join(differing)}: move it away, or give --again")
    return found


def write(results: Path, job: Job, result: dict[str, Any]) -> Path:
    """At once, and whole."""
    path = result_path(results, job)
    write_atomically(path, (json.dumps(result, separators=(",", ":")) + "\n").encode())
    return path


def complete(
    jobs: Sequence[Job],
    results: Path,
    runs: Path,
    workers: int = 2,
    again: bool = False,
    say: Callable[[str, str], object] = lambda name, text: None,
) -> list[dict[str, Any]]:
    """The jobs' results in their order; those that are not there yet are found out, `workers` at once.

    `say` is told a job's name and how far it is.

    Raises:
        StaleResultError: before anything is run; or whatever a job raised, once the others under way are done.
    """
    if again:
        for job in jobs:
            result_path(results, job).unlink(missing_ok=True)
    missing = [job for job in jobs if read(results, job) is None]
    if workers <= 1 or len(missing) <= 1:
        for job in missing:
            write(results, job, job.run(runs / job.robot / job.name, lambda text, job=job: say(job.name, text)))  # type: ignore[misc]
    else:
        _side_by_side(missing, results, runs, workers, say)
    found = [read(results, job) for job in jobs]
    return [result for result in found if result is not None]


def _side_by_side(
    jobs: Sequence[Job], results: Path, runs: Path, workers: int, say: Callable[[str, str], object]
) -> None:
    """Each in a process of its own."""
    context = spawning()
    reader, writer = context.Pipe(duplex=False)
    with reader, writer, ProcessPoolExecutor(workers, context, initializer=_begin_work, initargs=(writer,)) as pool:
        under_way = {pool.submit(_found_out, job, results, runs): job for job in jobs}
        while under_way:
            done, _ = wait(under_way, timeout=0.5, return_when=FIRST_COMPLETED)
            while reader.poll():
                say(*json.loads(reader.recv_bytes()))
            for future in done:
                job = under_way.pop(future)
                if future.exception() is not None:
                    for other in under_way:
                        other.cancel()
                future.result()
                say(job.name, "done")


_to_parent: list[Connection] = []  # in a worker: the pipe on which it reports its progress


def _begin_work(progress: Connection) -> None:
    """Begin a worker. It has one thread for NumPy, for two processes with two threads each on two cores are slower. It
    ends with its parent, however that one ends."""
    _to_parent.append(progress)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ^C is meant for them too, and needs no traceback

    def follow() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="follow the parent", daemon=True).start()


def _found_out(job: Job, results: Path, runs: Path) -> None:
    """Run a job in a worker: its result is on the disk before the parent knows of it."""

    def say(text: str) -> None:
        # Not longer than a pipe takes at once (4096 bytes): the workers share it.
        line = json.dumps([job.name, text[:LONGEST_LINE]], ensure_ascii=False)
        _to_parent[0].send_bytes(line.encode(errors="replace"))

    write(results, job, job.run(runs / job.robot / job.name, say))
