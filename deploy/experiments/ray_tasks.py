"""Run the tasks of a study on a Ray cluster: on this machine or on many, which need share no disk.

Each task gets the data sets and model sets of its robot as files, and returns the files that it wrote. A task whose
worker or node dies runs again elsewhere, from the start. Only this process stores results, and each one once.
Ray sends pickled objects between its processes: whoever reaches a cluster's ports controls it (docs/security.md).
"""

from __future__ import annotations

import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from brakeline.deploy.data.data_paths import data_root
from brakeline.deploy.experiments.task_engine import LONGEST_LINE, Say, StudyTask, T, folder_of
from brakeline.deploy.interpreter import ONE_THREAD
from brakeline.errors import NoCluster
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX, TASK_SEPARATOR
from brakeline.messaging.task import robot_with_task

LOCAL = "local"
RETRIES = 20  # of a task whose worker or node dies
ANSWERS_IN = 5.0  # s in which a cluster must take a connection
NEXT_LOOK = 0.5  # s between two looks at progress and results

Files = dict[str, bytes]  # content by path below a folder


def run_on_ray(tasks: Sequence[T], address: str, runs: Path, say: Say) -> Iterator[tuple[T, Any]]:
    """Run tasks on a Ray cluster, and yield each with its result once it is there; see `Engine.completed`."""
    failure: BaseException | None = None
    with _connected(address) as ray:
        supplies = {name: ray.put(supplies_of(name)) for name in {task.robot for task in tasks}}
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=True
        )
        progress = ray.remote(num_cpus=0)(_Progress).options(scheduling_strategy=here).remote()
        run = ray.remote(num_cpus=1, max_calls=1, max_retries=RETRIES)(_run_remotely)  # a process for each task
        under_way = {run.remote(task, supplies[task.robot], progress): task for task in tasks}
        while under_way:
            done, _ = ray.wait(list(under_way), timeout=NEXT_LOOK)
            with suppress(ray.exceptions.RayError):  # without it, only the progress is lost
                for name, text in ray.get(progress.take.remote()):
                    say(name, text)
            for reference in done:
                task = under_way.pop(reference)
                try:
                    result, files = ray.get(reference)
                except ray.exceptions.RayError as error:
                    failure = failure or getattr(error, "cause", None) or error
                    continue
                write_files(folder_of(runs, task), files)
                yield task, result
                say(task.name, "done")
    if failure is not None:
        raise failure


def supplies_of(robot: str) -> Files:
    """Return the data set and the model sets in use of a robot, by their paths below the data folder."""
    name = robot_with_task(robot).name if robot.endswith(".toml") else robot.partition(TASK_SEPARATOR)[0]
    folders = [data_root() / folder for folder in {name, name.removesuffix(REAL_TIME_SUFFIX)}]
    paths = [path for folder in folders for path in sorted(folder.glob("*")) if path.is_file()]
    return {str(path.relative_to(data_root())): path.read_bytes() for path in paths}


def write_files(folder: Path, files: Files) -> None:
    """Write files below a folder, each atomically.

    Raises:
        ValueError: a path leads out of the folder.
    """
    for name, content in files.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{name} leads out of {folder}")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Yield the module of Ray, connected to a cluster; `LOCAL` starts one that ends with the block.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        NoCluster: there is no cluster at this address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    options: dict[str, Any] = {"runtime_env": {"env_vars": ONE_THREAD}, "log_to_driver": False}
    if address == LOCAL:
        options["include_dashboard"] = False
    try:
        host, _, port = address.rpartition(":")
        if port.isdecimal():  # Ray itself would try for minutes
            socket.create_connection((host.rpartition("/")[2], int(port)), ANSWERS_IN).close()
        ray.init(address, logging_level="ERROR", **options)
    except (OSError, ValueError, RuntimeError) as error:
        raise NoCluster(f"no Ray cluster at {address!r}: {error}. `ray start --head` starts one") from error
    try:
        yield ray
    finally:
        ray.shutdown()


class _Progress:
    """The progress that tasks reported and that nobody has taken yet. It runs as an actor of Ray."""

    def __init__(self) -> None:
        self._lines: list[tuple[str, str]] = []

    def add(self, name: str, text: str) -> None:
        self._lines.append((name, text))

    def take(self) -> list[tuple[str, str]]:
        lines, self._lines = self._lines, []
        return lines


def _run_remotely(task: StudyTask, supplies: Files, progress: Any) -> tuple[Any, Files]:
    """Run a task in a worker, with its supplies in a data folder of its own. Returns its result and its files."""
    say: Callable[[str], object] = lambda text: progress.add.remote(task.name, text[:LONGEST_LINE])  # noqa: E731
    with tempfile.TemporaryDirectory(prefix="brakeline-") as place:
        data, folder = Path(place) / "data", Path(place) / "run"
        write_files(data, supplies)
        os.environ["BRAKELINE_DATA"] = str(data)
        started = time.time()
        say(f"begun on {os.uname().nodename}")
        result = task.run(folder, say)
        say(f"took {time.time() - started:.0f} s")
        written = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return result, {str(path.relative_to(folder)): path.read_bytes() for path in written}
