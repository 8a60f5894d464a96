"""A process that dies, or a disk that is full, at the n-th call that changes what is on the disk."""

from __future__ import annotations

import builtins
import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

CHANGES = ("fsync", "mkdir", "rename", "replace", "rmdir", "unlink", "symlink", "truncate", "ftruncate")


class Died(BaseException):
    """The process is dead: no cleanup of it changes the disk either."""


def full() -> OSError:
    """What a full disk answers."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class DiskCalls:
    """Counts the calls that change the files below a folder; from the n-th on, they fail.

    Attributes:
        seen: names of the calls so far.
        files: that were opened to be written.
    """

    def __init__(self, folder: Path, fails_at: int, error: Callable[[], BaseException], frees_space: bool) -> None:
        self.seen: list[str] = []
        self.files: list[Any] = []
        self._folder, self._fails_at, self._error, self._frees_space = str(folder), fails_at, error, frees_space

    def count(self, name: str) -> bool:
        """Count a call. Returns whether it fails."""
        self.seen.append(name)
        failing = len(self.seen) > self._fails_at
        return failing and not (self._frees_space and name in ("rmdir", "unlink", "ftruncate", "truncate"))

    def concerns(self, where: Any) -> bool:
        if isinstance(where, int):
            where = Path(f"/proc/self/fd/{where}").readlink()
        return str(where).startswith(self._folder)

    def wrapped(self, name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def call(where: Any, *rest: Any, **named: Any) -> Any:
            ours = "dir_fd" in named or self.concerns(where)  # rmtree's own way to name files
            if ours and self.count(name):
                raise self._error()
            return None if name == "fsync" and ours else real(where, *rest, **named)

        return call

    def opened(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(where: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
            if not set(mode) & set("wxa+") or not self.concerns(where):
                return real(where, mode, *rest, **named)
            if self.count("open"):
                raise self._error()
            file = real(where, mode, *rest, **named)
            self.files.append(file)
            return FailingFile(file, self, self._error)

        return call


class FailingFile(AbstractContextManager["FailingFile"]):
    """A file whose writes fail half-way."""

    def __init__(self, file: Any, calls: DiskCalls, error: Callable[[], BaseException]) -> None:
        self._file, self._calls, self._error = file, calls, error

    def write(self, data: Any) -> int:
        if self._calls.count("write"):
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            raise self._error()
        return self._file.write(data)

    def truncate(self, size: int) -> int:
        self._calls.count("truncate")
        return self._file.truncate(size)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __exit__(self, *_: object) -> None:
        self._file.close()


@contextmanager
def failing(folder: Path, at: int, error: Callable[[], BaseException] = Died) -> Iterator[DiskCalls]:
    """Within the block, each change below the folder fails after `at` of them. A full disk can still delete."""
    calls = DiskCalls(folder, at, error, frees_space=error is full)
    wrapped: dict[str, Any] = {name: calls.wrapped(name) for name in CHANGES}
    with (
        patch.multiple(os, **wrapped, fdopen=calls.opened(os.fdopen)),
        patch.object(io, "open", calls.opened(io.open)),
        patch.object(builtins, "open", calls.opened(builtins.open)),
    ):
        yield calls
    for file in calls.files if error is Died else ():  # as the end of a process does
        file.close()
