"""Read mutated logs of every format: each must be read or refused with one of Brakeline's own errors, in bounded time.

    python -m tests.fuzz.log_fuzz FOLDER --count 100000            # all formats; start it again to go on
    python -m tests.fuzz.log_fuzz FOLDER --kinds ulog ros1 --count 2000

Worker processes read the files with the same code and the same memory limit as the process that the product starts for
each file. A file that takes too long there, or ends the worker, is read once more as the product does it.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import psutil

from brakeline.deploy.data.description_template import fill_template
from brakeline.deploy.data.embedded_description import read_embedded_description
from brakeline.deploy.data.importer import OWN, reader_of, tables_of, with_time
from brakeline.deploy.data.log_options import PLAIN
from brakeline.deploy.data.resample import resample
from brakeline.deploy.data.run_dataset import from_log
from brakeline.deploy.data.schema_inference import infer_schema
from brakeline.deploy.data.sources.isolated_reader import GIB, packed, read_here, set_limits
from brakeline.deploy.data.sources.source_table import Table
from brakeline.deploy.interpreter import PYTHON
from brakeline.errors import BrakelineError
from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
from brakeline.logs.log_recovery import recover
from brakeline.logs.reader import open_log
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from tests.deploy.data.porter import porter
from tests.fuzz.log_seeds import SEEDS, seed
from tests.fuzz.mutations import mutated
from tests.robots import GROUND

HANG = 10.0  # s for one file
BATCH = 20_000  # files of one worker
COUNTS = ("next", "read", "refused", "limited", "tracebacks", "hangs", "peak_mib")
NEXT, READ, REFUSED, LIMITED, TRACEBACKS, HANGS, PEAK = range(len(COUNTS))
T = TypeVar("T")
ROBOT = porter()
TEMPLATE = (ROBOTS_FOLDER / "template.txt").read_text()


class Refused(Exception):
    """The file was refused with one of Brakeline's own errors."""


def own_errors(function: Callable[..., T], *arguments: Any) -> T:
    """Call a function. Raises Refused instead of Brakeline's own errors, which must have a message."""
    try:
        return function(*arguments)
    except BrakelineError as error:
        assert str(error), "an error without a message"
        raise Refused from error


def read_foreign(reader: str, path: Path) -> None:
    """Read a foreign log as `robot new --from` and `import` do, without a process of its own."""
    tables = own_errors(read_here, reader, path)
    packed(tables)
    tables = own_errors(with_time, tables, path, PLAIN)
    for use in (describe, lambda tables: resample(tables, ROBOT, PLAIN)):
        with suppress(Refused):
            own_errors(use, tables)


def describe(tables: list[Table]) -> None:
    fill_template(TEMPLATE, infer_schema(tables), "a log")


def read_run(path: Path) -> None:
    """Read the log of a run as `import`, `robot new --from`, `analyse` and `recover` do."""
    own_errors(list, open_log(path))
    for use in (
        lambda: from_log(path, GROUND, 1000),
        lambda: read_embedded_description(path, "a"),
        lambda: analyse_runs([path], AnalysisOptions()).figures(),
        lambda: recover(path, path.with_suffix(".out")),
    ):
        with suppress(Refused):
            own_errors(use)
    path.with_suffix(".out").unlink(missing_ok=True)


def outcome(path: Path) -> int:
    """Read a file. Returns READ, REFUSED or LIMITED; any other error is raised."""
    try:
        reader = own_errors(reader_of, path)
        if reader == OWN:
            read_run(path)
        else:
            read_foreign(reader, path)
    except Refused:
        return REFUSED
    except MemoryError:
        return LIMITED  # in the product, the process of the reader ends with an error that names the limit
    return READ


def work(kind: str, state: Path, end: int) -> None:
    """Read files up to the number `end` in this process, from the one after the last that was read."""
    counts = np.memmap(state / f"{kind}.counts", np.int64, "r+", shape=len(COUNTS))
    set_limits(1e6, 4 * GIB)
    os.chdir(state)
    with TemporaryDirectory() as folder, Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        path = seed(kind, Path(folder))
        data, target = path.read_bytes(), path.with_stem("mutated")
        while counts[NEXT] < end:
            number = int(counts[NEXT])
            target.write_bytes(mutated(data, Random(f"{kind} {number}")))
            try:
                counts[outcome(target)] += 1
            except Exception:
                counts[TRACEBACKS] += 1
                shutil.copy(target, state / f"{kind}-{number}{target.suffix}")
                with (state / f"{kind}.tracebacks").open("a") as report:
                    print(f"--- {number}", traceback.format_exc(limit=-4), file=report, sep="\n", flush=True)
            counts[NEXT] = number + 1
            counts[PEAK] = max(counts[PEAK], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)


def ended(path: Path) -> int:
    """Read a file, with which a worker did not go on, as the product does. Returns LIMITED, HANGS or TRACEBACKS."""
    start = time.monotonic()
    try:
        own_errors(tables_of, path)
    except Refused:
        pass
    except Exception:
        return TRACEBACKS
    return HANGS if time.monotonic() - start > HANG else LIMITED


def supervise(kind: str, state: Path, end: int) -> dict[str, int]:
    """Read the files of a format up to the number `end` in worker processes. Returns the counts of all files."""
    file = state / f"{kind}.counts"
    if not file.exists():
        np.zeros(len(COUNTS), np.int64).tofile(file)
    counts = np.memmap(file, np.int64, "r+", shape=len(COUNTS))
    while counts[NEXT] < end:
        command = [*PYTHON, "-m", __spec__.name if __spec__ else "tests.fuzz.log_fuzz", str(state), "--work", kind]
        worker = psutil.Popen([*command, "--count", str(min(end, int(counts[NEXT]) + BATCH))])
        at, since = -1, 0.0
        while worker.poll() is None:
            time.sleep(0.2)
            with suppress(psutil.Error):
                used = sum(worker.cpu_times()[:2])
                if counts[NEXT] != at:
                    at, since = int(counts[NEXT]), used
                elif at and used - since > HANG:
                    worker.kill()
                    worker.wait()
        if worker.returncode and counts[NEXT] < end:
            number = int(counts[NEXT])
            with TemporaryDirectory() as folder:
                path = seed(kind, Path(folder))
                target = path.with_stem("mutated")
                target.write_bytes(mutated(path.read_bytes(), Random(f"{kind} {number}")))
                shutil.copy(target, state / f"{kind}-{number}{target.suffix}")
                counts[ended(target)] += 1
            counts[NEXT] = number + 1
    return dict(zip(COUNTS, map(int, counts), strict=True))


def main() -> None:
    """Read mutated logs, and print the counts by format."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("state", type=Path, help="folder of the counts and of the files that failed")
    parser.add_argument("--kinds", nargs="+", default=list(SEEDS), choices=list(SEEDS))
    parser.add_argument("--count", type=int, default=100_000, help="files of each format")
    parser.add_argument("--work", choices=list(SEEDS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    state = options.state.resolve()
    if options.work:
        work(options.work, state, options.count)
        return
    state.mkdir(parents=True, exist_ok=True)
    for kind in options.kinds:
        start = time.monotonic()
        counts = supervise(kind, state, options.count)
        print(f"{kind}: {counts}, {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
