"""Run the jobs of an experiment, and skip those that have a result."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import MISSING, Field, asdict, fields, is_dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, ClassVar, Protocol

from brakeline.deploy.data.build_lock import lock_at_once
from brakeline.deploy.experiments.task_engine import IN_THIS_PROCESS, Engine, Say, StudyTask, robot_folder, unsaid
from brakeline.errors import BadText, ResultError
from brakeline.messaging.atomic_files import write_atomically
from brakeline.messaging.robot_files import REAL_TIME_SUFFIX, task_values
from brakeline.messaging.structured_text import parse_json

LOCK = ".study.lock"


class Job(StudyTask, Protocol):
    """One job of an experiment: a dataclass whose fields are its configuration. Its `name` names the result."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


def configuration(job: Job) -> dict[str, Any]:
    """Return the fields of a job as JSON values."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(job)))
    return values


def task_hash(robot: str) -> str:
    """Return a hash of the files that describe a robot of your own and its task, so that a changed one is noticed.

    robot: its name or path. The hash is empty for a robot that comes with Brakeline.
    """
    from brakeline.messaging.task import robot_with_task, task_path  # slow to import

    if not robot.removesuffix(REAL_TIME_SUFFIX).endswith(".toml"):
        return ""
    values = robot_with_task(robot).description, task_values(task_path(robot))
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]


def result_path(results: Path, job: Job) -> Path:
    """Return the path of a job's result file."""
    return robot_folder(results, job.robot) / f"{job.name}.json"


def read(results: Path, job: Job) -> dict[str, Any] | None:
    """Return the stored result of a job, or None if there is none.

    Raises:
        ResultError: the file is damaged, or the result was made with other settings; the message names them.
    """
    path = result_path(results, job)
    if not path.exists():
        return None
    result = stored_result(path)
    stored, current = _completed(result["study"], job), configuration(job)
    differing = sorted(name for name in stored | current if stored.get(name) != current.get(name))
    if differing:
        raise ResultError(
            f"{path} was made with another {', '.join(differing)}: move it away, or run again with --again"
        )
    return result


def stored_result(path: Path) -> dict[str, Any]:
    """Return the content of a result file. Raises ResultError: it is damaged."""
    try:
        result = parse_json(path.read_bytes())
    except BadText as error:
        raise ResultError(f"{path} is damaged ({error}): move it away, or run again with --again") from error
    if not isinstance(result, dict) or not isinstance(result.get("study"), dict):
        raise ResultError(f"{path} holds no result of a study: move it away, or run again with --again")
    return result


def _completed(stored: dict[str, Any], job: Any) -> dict[str, Any]:
    """Return a stored configuration with the defaults of the fields that its version did not have yet."""
    values = dict(stored)
    for field in fields(job):
        value = getattr(job, field.name)
        if is_dataclass(value) and isinstance(values.get(field.name), dict):
            values[field.name] = _completed(values[field.name], value)
        elif field.name not in values and (default := _default(field)) is not MISSING:
            values[field.name] = default
    return values


def _default(field: Field[Any]) -> Any:
    """Return the default of a field as a JSON value; `MISSING` if it has none."""
    default = field.default if field.default_factory is MISSING else field.default_factory()
    if default is MISSING:
        return default
    plain = asdict(default) if is_dataclass(default) and not isinstance(default, type) else default
    return json.loads(json.dumps(plain))


def check_writable(folder: Path) -> None:
    """Raise OSError if the folder cannot hold results, before a job runs for hours."""
    folder.mkdir(parents=True, exist_ok=True)
    TemporaryFile(dir=folder).close()


@contextmanager
def only_study(folders: Iterable[Path]) -> Iterator[None]:
    """Hold the locks of folders of run data until the block ends. Raises ResultError: another study holds one."""
    with ExitStack() as locks:
        for folder in sorted(set(folders)):
            folder.mkdir(parents=True, exist_ok=True)
            if not locks.enter_context(lock_at_once(folder / LOCK)):
                raise ResultError(
                    f"another study runs in {folder}, and both would write the same logs: wait until it ends, then run "
                    "this one again. To run them side by side, give another --runs and another --results"
                )
        yield


def write(results: Path, job: Job, result: dict[str, Any]) -> None:
    """Write a result atomically."""
    write_atomically(result_path(results, job), (json.dumps(result, separators=(",", ":")) + "\n").encode())


def complete(
    jobs: Sequence[Job],
    results: Path,
    runs: Path,
    engine: Engine = IN_THIS_PROCESS,
    again: bool = False,
    say: Say = unsaid,
) -> list[dict[str, Any]]:
    """Run the jobs without a result, and return all results in order. Each result is stored as soon as it is there.

    Args:
        jobs: the jobs; results, runs: folders of results and of run data.
        engine: what runs them.
        again: delete existing results first.
        say: called with a job's name and its progress.

    Raises:
        ResultError: a result was made with other settings, two jobs have one name, or another process runs a study of
            the same robot in `runs`; raised before any job runs.
        OSError: a result cannot be stored. If its folder cannot be written, raised before any job runs.
        Any exception of a job, after the jobs that already run have ended.
    """
    paths = Counter(result_path(results, job) for job in jobs)
    if twice := [path for path, count in paths.items() if count > 1]:
        raise ResultError(f"{twice[0]} would hold two results: give each setting once, and files different names")
    missing = [job for job in jobs if again or read(results, job) is None]
    for folder in {result_path(results, job).parent for job in missing}:
        check_writable(folder)
    with only_study(robot_folder(runs, job.robot) for job in missing):
        if again:
            for job in jobs:
                result_path(results, job).unlink(missing_ok=True)
        # Another study may have ended in the meantime.
        missing = [job for job in missing if read(results, job) is None]
        for job, result in engine.completed(missing, runs, say):
            write(results, job, result)
    return [result for job in jobs if (result := read(results, job)) is not None]
