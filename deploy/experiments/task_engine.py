"""Run the tasks of a study side by side: in worker processes of this machine, or on a Ray cluster.

Keep the imports of this module light: a worker imports what its task needs.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

import tyro

from brakeline.deploy.interpreter import ONE_THREAD, end_with_spawner, spawning
from brakeline.errors import WorkerKilled
from brakeline.messaging.structured_text import parse_json

LONGEST_LINE = 500  # characters per progress message
KILLED = (
    "a worker process was killed, perhaps because the memory was full: run the command again, if need be with fewer "
    "--workers. A study goes on after the results that it has stored"
)

Say = Callable[[str, str], object]  # called with a task's name and its progress


class StudyTask(Protocol):
    """A part of a study: an object that a process can hand to another one."""

    @property
    def robot(self) -> str:
        """The robot, whose data and model sets the task needs."""

    @property
    def name(self) -> str:
        """The name in reports of progress."""

    def run(self, folder: Path, say: Callable[[str], object]) -> Any:
        """Run the task, and return its result. folder: for its files; say: reports progress."""


T = TypeVar("T", bound=StudyTask)


def unsaid(name: str, text: str) -> None:
    """Ignore the progress."""


@dataclass(frozen=True)
class Engine:
    """Choose where the parts of a study run."""

    workers: int = 1
    """Use this many processes of this machine at once, each on one core."""
    ray: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = ""
    """Use a Ray cluster instead: local starts one on this machine, auto takes the running one, and HOST:PORT takes the
    one at this address. A part whose machine dies runs again. You need the extra ray."""

    def __post_init__(self) -> None:
        """Raises ValueError: there is no worker."""
        if self.workers < 1:
            raise ValueError(f"--workers is a number from 1 on, not {self.workers}")

    def completed(self, tasks: Sequence[T], runs: Path, say: Say) -> Iterator[tuple[T, Any]]:
        """Run tasks, and yield each with its result once it is there.

        Args:
            runs: folder of their files, `runs/<robot>/<name>` for each.
            say: called with a task's name and its progress.

        Raises:
            ModuleNotFoundError: Ray is not installed.
            NoCluster: there is no Ray cluster at this address.
            WorkerKilled: a worker process was killed, and the others with it.
            Any exception of a task, after the tasks that already run have ended; on Ray, after all others have.

        If the caller stops, because it cannot store a result or the user presses Ctrl-C, no task goes on.
        """
        if self.ray and tasks:
            from brakeline.deploy.experiments.ray_tasks import run_on_ray

            yield from run_on_ray(tasks, self.ray, runs, say)
        elif self.workers <= 1 or len(tasks) <= 1:
            for task in tasks:
                yield task, task.run(folder_of(runs, task), lambda text, task=task: say(task.name, text))  # type: ignore[misc]
        else:
            yield from _run_in_processes(tasks, self.workers, runs, say)


IN_THIS_PROCESS = Engine()


def folder_of(runs: Path, task: StudyTask) -> Path:
    """Return the folder of a task's files."""
    return robot_folder(runs, task.robot) / task.name


def robot_folder(root: Path, robot: str) -> Path:
    """Return the folder of a robot's files, by its name or the path of its description.

    >>> robot_folder(Path("results"), "ground+tracks").name, robot_folder(Path("results"), "/home/me/my.toml").name
    ('ground+tracks', 'my')
    """
    return root / Path(robot).stem


def _run_in_processes(tasks: Sequence[T], workers: int, runs: Path, say: Say) -> Iterator[tuple[T, Any]]:
    context, failure, others = spawning(), None, set(active_children())
    reader, writer = context.Pipe(duplex=False)
    workers = min(workers, len(tasks))
    with reader, writer, ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(writer,)) as pool:
        try:
            under_way = {pool.submit(_run_task, task, folder_of(runs, task)): task for task in tasks}
            # The pool wakes its watcher before it starts a worker, whose death may then go unnoticed: wake it again.
            pool.submit(_nothing)
            while under_way:
                done, _ = wait(under_way, timeout=0.5, return_when=FIRST_COMPLETED)
                while reader.poll():
                    say(*parse_json(reader.recv_bytes()))
                for future in done:
                    task = under_way.pop(future)
                    if future.cancelled():
                        continue
                    if error := future.exception():
                        failure = failure or error
                        for other in under_way:
                            other.cancel()
                    else:
                        yield task, future.result()
                        say(task.name, "done")
        except BaseException:  # nobody takes further results: Ctrl-C, or the last one could not be stored
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(active_children()) - others:
                worker.kill()
            raise
    if isinstance(failure, BrokenProcessPool):
        raise WorkerKilled(KILLED) from failure
    if failure is not None:
        raise failure


_to_parent: list[Connection] = []  # in a worker: the pipe on which it reports its progress


def _start_worker(progress: Connection) -> None:
    """Start a worker that ends with its parent, however the parent ends."""
    _to_parent.append(progress)
    os.environ |= ONE_THREAD
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends workers too, without a traceback
    if not end_with_spawner(signal.SIGKILL):
        os._exit(1)


def _nothing() -> None:
    """Return."""


def _run_task(task: StudyTask, folder: Path) -> Any:
    def say(text: str) -> None:
        # The workers share the pipe, which writes up to 4096 bytes atomically.
        line = json.dumps([task.name, text[:LONGEST_LINE]], ensure_ascii=False)
        _to_parent[0].send_bytes(line.encode(errors="replace"))

    return task.run(folder, say)
