"""Read a foreign log in a process of its own, with limits on its time and memory.

The parsers of foreign formats are other people's programs. A damaged file can make them raise any error, loop for ever,
fill the memory or crash. Here that ends one process, and becomes one error that names the file. The process hands the
tables back as arrays in a temporary file (`numpy.savez`), without pickle.

`python -m brakeline.deploy.data.sources.isolated_reader READER PATH FD SECONDS BYTES` is the process.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, Any

import numpy as np

from brakeline.deploy.data.sources.source_table import Table
from brakeline.deploy.interpreter import PYTHON, end_with_parent
from brakeline.errors import NoSource

GIB = 2**30
LEAST_SECONDS, SECONDS_A_BYTE = 3.0, 5e-6  # the usual limit of time; good files take a tenth of it
WAITING = 60.0  # s by the clock, besides four times the limit of computing time: a busy machine must not end a reader
HEADER = "header"  # name of the array with everything but arrays, as JSON


@dataclass(frozen=True)
class ReadLimits:
    """The limits of reading one log.

    Attributes:
        seconds: of computing time. 0: 3 s, and 1 s more for each 200 kB.
        gib: memory in GiB.
    """

    seconds: float = 0.0
    gib: float = 4.0

    def __post_init__(self) -> None:
        """Refuse limits that no file can keep."""
        if self.seconds < 0.0 or self.gib <= 0.0:
            raise ValueError("--read-seconds must be at least 0, and --read-gib above 0")

    def seconds_for(self, path: Path) -> float:
        """Return the limit of computing time for a file, or for all files of a folder."""
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        return self.seconds or LEAST_SECONDS + SECONDS_A_BYTE * sum(file.stat().st_size for file in files)


USUAL_LIMITS = ReadLimits()


def read_isolated(reader: str, path: Path, limits: ReadLimits) -> list[Table]:
    """Read a log in a process of its own.

    Args:
        reader: MODULE:FUNCTION in this package.
        path: a file or folder.
        limits: of the process.

    Raises:
        NoSource: the log cannot be read; the message names the file, the reason and what to do.
        ModuleNotFoundError: an optional package is missing.
    """
    seconds = limits.seconds_for(path)
    with tempfile.TemporaryFile() as answer:
        words = [reader, str(path), str(answer.fileno()), str(seconds), str(int(limits.gib * GIB))]
        command = [*PYTHON, "-m", __name__, *words, str(os.getpid())]
        try:
            ended = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(answer.fileno(),),
                timeout=4.0 * seconds + WAITING,
                check=False,
            )
            status = -ended.returncode
        except subprocess.TimeoutExpired:
            status = int(signal.SIGXCPU)
        if status:
            raise NoSource(f"{path}: {_why(status, seconds, limits)}")
        answer.seek(0)
        return _unpacked(answer, path, limits)


def _why(status: int, seconds: float, limits: ReadLimits) -> str:
    """Return the reason why a reader ended by a signal."""
    if status == signal.SIGXCPU:
        return (
            f"reading it takes more than {seconds:.0f} s. The file is damaged, or this machine is slow: "
            "then raise the limit with --read-seconds"
        )
    if status == signal.SIGKILL:
        return f"the system ended its reader, probably for memory (limit {limits.gib:g} GiB: --read-gib)"
    name = signal.Signals(status).name if status in set(signal.Signals) else f"status {-status}"
    return f"its reader crashed ({name}). The file is damaged: check it with the program that wrote it"


# --- the answer: one JSON header and arrays ---


def packed(tables: list[Table]) -> dict[str, np.ndarray]:
    """Return the arrays of tables, named by table, field and column, and the header."""
    header: list[dict[str, Any]] = []
    result: dict[str, np.ndarray] = {}
    for i, table in enumerate(tables):
        values = {field.name: getattr(table, field.name) for field in fields(table)}
        columns = values.pop("columns")
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        result |= {f"{i}.{name}": value for name, value in arrays.items()}
        result |= {f"{i}.columns.{k}": column for k, column in enumerate(columns.values())}
        plain = {name: value for name, value in values.items() if name not in arrays}
        header.append({"plain": plain, "arrays": list(arrays), "columns": list(columns)})
    return result | {HEADER: _as_array({"tables": header})}


def _as_array(header: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(json.dumps(header).encode(), np.uint8)


def _unpacked(file: IO[bytes], path: Path, limits: ReadLimits) -> list[Table]:
    with np.load(file) as arrays:
        header = json.loads(arrays[HEADER].tobytes())
        if "missing" in header:
            raise ModuleNotFoundError(header["error"], name=header["missing"])
        if "memory" in header:
            raise NoSource(
                f"{path}: reading it takes more than {limits.gib:g} GiB of memory. The file is damaged, or it is "
                "large: then raise the limit with --read-gib"
            )
        if "error" in header:
            raise NoSource(header["error"])
        return [_table(arrays, str(i), about) for i, about in enumerate(header["tables"])]


def _table(arrays: Any, i: str, about: dict[str, Any]) -> Table:
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in about["plain"].items()
    }
    values |= {name: arrays[f"{i}.{name}"] for name in about["arrays"]}
    columns = {name: arrays[f"{i}.columns.{k}"] for k, name in enumerate(about["columns"])}
    return Table(columns=columns, **values)


# --- the process ---


def read_here(reader: str, path: Path) -> list[Table]:
    """Read a log in this process.

    Raises:
        NoSource: the log cannot be read. Every error of a parser becomes one.
    """
    module, _, name = reader.partition(":")
    try:
        tables: list[Table] = getattr(importlib.import_module(f"{__package__}.{module}"), name)(path)
    except (NoSource, MemoryError, ModuleNotFoundError):
        raise
    except PermissionError as error:
        raise NoSource(f"{path}: you may not read it ({error}). Give yourself the permission, or copy it") from error
    except Exception as error:  # parsers raise many types
        raise NoSource(
            f"{path}: its reader stopped with {type(error).__name__}: {error}. The file is damaged: check it with the "
            "program that wrote it"
        ) from error
    return tables


def _answer(reader: str, path: Path, out: IO[bytes]) -> None:
    """Write the tables, or the error, to `out`."""
    try:
        _save(out, packed(read_here(reader, path)))
        return
    except MemoryError:
        header: dict[str, Any] = {"memory": True}
    except ModuleNotFoundError as error:
        header = {"missing": error.name, "error": str(error)}
    except NoSource as error:
        header = {"error": str(error)}
    out.seek(0)
    out.truncate()
    _save(out, {HEADER: _as_array(header)})


def _save(out: IO[bytes], arrays: dict[str, Any]) -> None:
    np.savez(out, **arrays)


def set_limits(seconds: float, size: int) -> None:
    """Limit this process: its further computing time in s, and its memory in bytes. It leaves no core file."""
    used = sum(os.times()[:2])
    limits = {resource.RLIMIT_CPU: int(used + seconds) + 1, resource.RLIMIT_CORE: 0}
    limits |= {resource.RLIMIT_AS: size, resource.RLIMIT_FSIZE: size}
    for kind, limit in limits.items():
        most = resource.getrlimit(kind)[1]  # of the user, who may have set less
        resource.setrlimit(kind, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def main(words: list[str]) -> None:
    """Read a log, as the words of the command line say."""
    reader, path, out, seconds, size, parent = words
    end_with_parent(int(parent), signal.SIGKILL)
    os.environ |= {"ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
    set_limits(float(seconds), int(size))
    with os.fdopen(int(out), "wb") as file:
        _answer(reader, Path(path), file)


if __name__ == "__main__":
    main(sys.argv[1:])
