"""Run the jobs of an experiment in worker processes, and skip those that have a result.

Keep the imports of this module light: a worker imports what its job needs.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ClassVar, Protocol

from brakeline.deploy.interpreter import end_with_parent, spawning
from brakeline.errors import ResultError
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.structured_text import parse_json

LONGEST_LINE = 500  # characters per progress message


class Job(Protocol):
    """One job of an experiment: a dataclass whose fields are its configuration. Its `name` names the result."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def robot(self) -> str:
        """The robot, whose folder gets the result."""

    @property
    def name(self) -> str:
        """The name of the result."""

    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        """Run the job in a folder, and return its result. say: reports progress."""


def configuration(job: Job) -> dict[str, Any]:
    """Return the fields of a job as JSON values."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(job)))
    return values


def result_path(results: Path, job: Job) -> Path:
    """Return the path of a job's result file."""
    return results / job.robot / f"{job.name}.json"


def read(results: Path, job: Job) -> dict[str, Any] | None:
    """Return the stored result of a job, or None if there is none.

    Raises:
        ResultError: the result was made with other settings; the message names them.
    """
    path = result_path(results, job)
    if not path.exists():
        return None
    result: dict[str, Any] = parse_json(path.read_text())
    stored, current = result.get("study", {}), configuration(job)
    differing = sorted(name for name in stored | current if stored.get(name) != current.get(name))
    if differing:
        raise ResultError(
            f"{path} was made with another {', '.join(differing)}: move it away, or run again with --again"
        )
    return result


def write(results: Path, job: Job, result: dict[str, Any]) -> Path:
    """Write a result atomically, and return its path."""
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
    """Run the jobs without a result, `workers` at a time, and return all results in order.

    Args:
        jobs: the jobs; results, runs: folders of results and of run data.
        again: delete existing results first.
        say: called with a job's name and its progress.

    Raises:
        ResultError: a result was made with other settings; raised before any job runs.
        Any exception of a job, after the jobs that already run have ended.
    """
    if again:
        for job in jobs:
            result_path(results, job).unlink(missing_ok=True)
    missing = [job for job in jobs if read(results, job) is None]
    if workers <= 1 or len(missing) <= 1:
        for job in missing:
            write(results, job, job.run(runs / job.robot / job.name, lambda text, job=job: say(job.name, text)))  # type: ignore[misc]
    else:
        _run_in_workers(missing, results, runs, workers, say)
    stored = [read(results, job) for job in jobs]
    return [result for result in stored if result is not None]


def _run_in_workers(
    jobs: Sequence[Job], results: Path, runs: Path, workers: int, say: Callable[[str, str], object]
) -> None:
    """Run each job in a process of its own."""
    context = spawning()
    reader, writer = context.Pipe(duplex=False)
    with reader, writer, ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(writer,)) as pool:
        under_way = {pool.submit(_run_job, job, results, runs): job for job in jobs}
        while under_way:
            done, _ = wait(under_way, timeout=0.5, return_when=FIRST_COMPLETED)
            while reader.poll():
                say(*parse_json(reader.recv_bytes()))
            for future in done:
                job = under_way.pop(future)
                if future.exception() is not None:
                    for other in under_way:
                        other.cancel()
                future.result()
                say(job.name, "done")


_to_parent: list[Connection] = []  # in a worker: the pipe on which it reports its progress


def _start_worker(progress: Connection) -> None:
    """Start a worker that ends with its parent, however the parent ends.

    NumPy gets one thread: two processes with two threads each are slower on two cores.
    """
    _to_parent.append(progress)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends workers too, without a traceback
    parent = multiprocessing.parent_process()
    if parent is None or parent.pid is None or not end_with_parent(parent.pid, signal.SIGKILL):
        os._exit(1)


def _run_job(job: Job, results: Path, runs: Path) -> None:
    """Run a job in a worker, and write its result before the parent learns that it ended."""

    def say(text: str) -> None:
        # The workers share the pipe, which writes up to 4096 bytes atomically.
        line = json.dumps([job.name, text[:LONGEST_LINE]], ensure_ascii=False)
        _to_parent[0].send_bytes(line.encode(errors="replace"))

    write(results, job, job.run(runs / job.robot / job.name, say))
