"""Checkpoints: the whole state of a learner on disk.

A checkpoint is a folder, `<root>/000042/`. It holds one safetensors file for each part, `manifest.json` with the hash
of each file and the plain values of the parts, and `manifest.sha256` with the hash of the manifest (`sha256sum -c`
checks it). The function `save` writes a folder `.partial`, renames it, notes its number in the file `latest`, and
deletes the checkpoints before it last. A kill or a full disk at any moment therefore leaves a whole checkpoint.

The latest checkpoint is the folder with the highest number. The file `latest` shows that this folder is not lost: no
folder with a number as high as the noted one is an error, never a fresh start. The function `load` verifies every hash.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from brakeline.errors import CheckpointError, DamagedPart
from brakeline.messaging.structured_text import parse_json

FORMAT = 2
CHECKPOINT = "checkpoint"  # the folder of a run's checkpoints
NOT_SAVED = "not saved"  # the note of a learner with the reason why its policy's file is not of the latest weights
LATEST = "latest"
MANIFEST = "manifest.json"
MANIFEST_HASH = "manifest.sha256"
PARTIAL = ".partial"
NUMBER = re.compile(r"\d{6,18}")  # the name of a checkpoint's folder


@dataclass(frozen=True)
class PartState:
    """The state of one part of the learner: arrays (stored as safetensors) and plain values (stored as JSON).

    Its methods raise ValueError.
    """

    tensors: dict[str, NDArray[Any]]
    values: dict[str, Any]

    def tensor(self, name: str, shape: tuple[int | None, ...], dtype: str) -> NDArray[Any]:
        """Return an array after a check of its shape (None: any length) and type."""
        if name not in self.tensors:
            raise ValueError(f"{name}: missing")
        array = self.tensors[name]
        fits = array.ndim == len(shape) and all(
            want in (None, have) for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits or array.dtype != np.dtype(dtype):
            raise ValueError(f"{name}: {array.dtype} {array.shape}, not {dtype} {shape}")
        return array

    def integer(self, name: str) -> int:
        """Return a value after a check that it is an integer."""
        value = self.value(name)
        if type(value) is not int:
            raise ValueError(f"{name}: {value!r} is not an integer")
        return value

    def value(self, name: str) -> Any:
        if name not in self.values:
            raise ValueError(f"{name}: missing")
        return self.values[name]


def exists(root: Path) -> bool:
    """Return whether there is a checkpoint, or a trace of one that is lost.

    Raises:
        CheckpointError: the folder cannot be read.
    """
    return (root / LATEST).exists() or bool(_folders(root))


def save(root: Path, parts: dict[str, PartState], about: dict[str, Any]) -> Path:
    """Write the latest checkpoint, and return its folder. Delete the checkpoints before it, and nothing else.

    Args:
        about: identifies the run (robot, configuration, …).

    Raises:
        CheckpointError: the checkpoint could not be written, or the one before is lost; what is there stays.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        place = root / f"{int(latest(root).name) + 1 if exists(root) else 1:06d}"
        partial = root / PARTIAL
        shutil.rmtree(partial, ignore_errors=True)  # of a save that was killed
        partial.mkdir()
        _write_parts(partial, parts, about)
        partial.rename(place)
        _sync(root)  # before anything is deleted
        _write(root / (LATEST + ".new"), place.name.encode())
        (root / (LATEST + ".new")).replace(root / LATEST)
    except (OSError, safetensors.SafetensorError) as error:
        shutil.rmtree(root / PARTIAL, ignore_errors=True)
        raise CheckpointError(f"{root}: not written: {error}") from error
    for old in _folders(root):
        if old != place:
            shutil.rmtree(old, ignore_errors=True)
    return place


def load(root: Path, names: tuple[str, ...]) -> tuple[dict[str, PartState], dict[str, Any]]:
    """Return the named parts of the latest checkpoint, and what `save` got as `about`.

    Raises:
        CheckpointError: there is no checkpoint.
        DamagedPart: a part is missing or damaged.
    """
    place = latest(root)
    manifest = _manifest(place)
    return {name: _part(place, name, manifest["parts"].get(name)) for name in names}, manifest["about"]


def about_latest(root: Path) -> dict[str, Any]:
    """Return what `save` got as `about` of the latest checkpoint. Raises as `load`."""
    about: dict[str, Any] = _manifest(latest(root))["about"]
    return about


def latest(root: Path) -> Path:
    """Return the folder of the latest checkpoint.

    Raises:
        CheckpointError: there is no checkpoint.
        DamagedPart: `latest` names a later checkpoint than there is.
    """
    folders, noted = _folders(root), _noted(root)
    if not folders and noted is None:
        raise CheckpointError(f"{root}: there is no checkpoint")
    if not folders or (noted is not None and int(folders[-1].name) < noted):
        raise DamagedPart(LATEST, root, f"missing: there are {', '.join(path.name for path in folders) or 'none'}")
    return folders[-1]


def _folders(root: Path) -> list[Path]:
    """Return the folders of the checkpoints, the latest one last."""
    try:
        folders = [path for path in root.iterdir() if NUMBER.fullmatch(path.name) and path.is_dir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise CheckpointError(f"{root}: not readable: {error}") from error
    return sorted(folders, key=lambda path: int(path.name))


def _noted(root: Path) -> int | None:
    """Return the number in the file `latest`; None if there is no such file. Raises DamagedPart."""
    try:
        name = (root / LATEST).read_bytes().decode(errors="replace").strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DamagedPart(LATEST, root, f"not readable: {error}") from error
    if not NUMBER.fullmatch(name):
        raise DamagedPart(LATEST, root, f"damaged: {name[:40]!r} is no number of a checkpoint")
    return int(name)


def _write_parts(folder: Path, parts: dict[str, PartState], about: dict[str, Any]) -> None:
    listed = {}
    for name, state in parts.items():
        payload = safetensors.numpy.save({key: np.ascontiguousarray(t) for key, t in state.tensors.items()})
        _write(folder / f"{name}.safetensors", payload)
        listed[name] = {"sha256": _hash(payload), "values": state.values}
    text = json.dumps({"format": FORMAT, "about": about, "parts": listed}, indent=1, sort_keys=True).encode()
    _write(folder / MANIFEST, text)
    _write(folder / MANIFEST_HASH, f"{_hash(text)}  {MANIFEST}\n".encode())
    _sync(folder)


def _manifest(place: Path) -> dict[str, Any]:
    """Return the manifest, which is parsed only if its hash is right.

    Raises:
        CheckpointError: an earlier version of Brakeline wrote it, without a hash.
        DamagedPart: it is damaged, or of another version.
    """
    text = _read(place, MANIFEST, MANIFEST)
    if not (place / MANIFEST_HASH).exists() and b'"format": 1,' in text:
        raise CheckpointError(
            f"{place}: an earlier version of Brakeline wrote this checkpoint (format 1); this version reads format "
            f"{FORMAT}, which has a hash. End the run with the earlier version; or move {place.parent} away, and learn "
            "again from the log: `brakeline train --resume RUN --from-logs RUN`"
        )
    stated = _read(place, MANIFEST_HASH, MANIFEST)
    if stated != f"{_hash(text)}  {MANIFEST}\n".encode():
        raise DamagedPart(MANIFEST, place, f"damaged: its hash is not the one in {MANIFEST_HASH}")
    manifest = parse_json(text)
    if manifest.get("format") != FORMAT:
        raise DamagedPart(MANIFEST, place, f"not of format {FORMAT}, but of another version of Brakeline")
    loaded: dict[str, Any] = manifest
    return loaded


def _part(place: Path, name: str, entry: dict[str, Any] | None) -> PartState:
    if entry is None:
        raise DamagedPart(name, place, "missing in the manifest")
    payload = _read(place, f"{name}.safetensors", name)
    if _hash(payload) != entry["sha256"]:
        raise DamagedPart(name, place, "damaged: its hash is not the one in the manifest")
    return PartState(safetensors.numpy.load(payload), entry["values"])


def _read(place: Path, file: str, part: str) -> bytes:
    """Return the bytes of a file of a checkpoint. Raises DamagedPart."""
    try:
        return (place / file).read_bytes()
    except FileNotFoundError:
        raise DamagedPart(part, place, f"missing: there is no {file}") from None
    except OSError as error:
        raise DamagedPart(part, place, f"not readable: {error}") from error


def _write(path: Path, payload: bytes) -> None:
    """Write a file to the disk."""
    with path.open("wb") as file:
        file.write(payload)
        file.flush()
        os.fsync(file.fileno())


def _hash(payload: bytes) -> str:
    return hashlib.sha256(payload).hexdigest()


def _sync(folder: Path) -> None:
    """Flush the entries of a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
