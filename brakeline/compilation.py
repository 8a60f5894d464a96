"""Compilation of loops that NumPy cannot express, with Numba.

Numba compiles them at the first import of their module on a machine, and caches the result. Import such a module where
it is needed, not at the top of a file: Numba takes 0.1 s to load.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])
log = logging.getLogger(__name__)

PARTS = ("safety", "sim")  # packages with folders `kernels`; kernels of one file call those of another
IMPORTED = re.compile(r"^from brakeline\.([\w.]+) import", re.MULTILINE)
STAMP = "kernels.sha256"  # beside the stored code: which sources it was compiled from


def compiled(signature: str | None = None) -> Callable[[F], F]:
    """Return a decorator that compiles a function for a signature in Numba's notation.

    `f8[::1]` is a contiguous array of float64. Arguments of other types raise TypeError. Without a signature, which has
    no words for records, the first call compiles the function for its arguments. Division by zero gives inf or NaN, as
    in NumPy. The compiled code does not check indices, unless NUMBA_BOUNDSCHECK=1 is set.
    """

    def decorate(function: F) -> F:
        try:
            _forget_stale(function)
            return cast(F, njit(signature, cache=True, error_model="numpy")(function))
        except (RuntimeError, OSError):  # no folder for the cache, or none to write in
            _say_that_nothing_is_stored()
            return cast(F, njit(signature, error_model="numpy")(function))

    return decorate


def _forget_stale(function: Callable[..., object]) -> None:
    """Delete the stored code of a function's folder if the kernels have changed since it was stored.

    Numba checks only the file of the function itself. If a kernel or a constant of another file changed, for example in
    an upgrade, Numba would go on with the old one.
    """
    folder = Path(function.__code__.co_filename).parent
    if folder in _checked:
        return
    compiled_later = njit(cache=True)(function)
    if stats := getattr(compiled_later, "stats", None):  # None with NUMBA_DISABLE_JIT=1
        stored = Path(stats.cache_path)
        _forget(stored, _sources())
        if not any(stored.glob("*.nbi")):
            _say_that_it_compiles()
    _checked.add(folder)


_checked: set[Path] = set()  # folders


def _forget(stored: Path, sources: str) -> None:
    """Delete the compiled code in a folder, unless its stamp names these sources."""
    stamp = stored / STAMP
    if stamp.exists() and stamp.read_text() == sources:
        return
    for code in (*stored.glob("*.nbi"), *stored.glob("*.nbc")):
        code.unlink(missing_ok=True)  # another process may do the same
    stamp.write_text(sources)


@cache
def _sources() -> str:
    """Return a digest of all kernels, and of the modules of ours that they import: their constants are compiled in."""
    here, digest = Path(__file__).parent, hashlib.sha256()
    kernels = {path for part in PARTS for path in (here / part).rglob("kernels/*.py")}
    imports = {name for path in kernels for name in IMPORTED.findall(path.read_text("utf-8"))}
    imported = {here.joinpath(*name.split(".")).with_suffix(".py") for name in imports}
    for path in sorted(kernels | {path for path in imported if path.exists()}):
        digest.update(str(path.relative_to(here)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@cache
def _say_that_it_compiles() -> None:
    """Log, once in a process, that it compiles: nothing else moves meanwhile."""
    log.warning("Brakeline compiles its loops for this computer, once: this takes about a minute")


@cache
def _say_that_nothing_is_stored() -> None:
    """Log, once in a process, that the compiled code cannot be stored."""
    log.warning(
        "Numba can store compiled code neither beside %s nor in your cache folder, so each process compiles for half a "
        "minute: set NUMBA_CACHE_DIR to a folder in which you may write",
        __file__,
    )
