"""Checkpoints: everything the learner is, or nothing.

A checkpoint is a folder, `<root>/000042/`, of one safetensors file per part and a `manifest.json` with each file's
hash and the parts' plain values. It is written as `.partial`, renamed, and only then does the one-line file `latest`
point to it, by an atomic replacement; older ones are deleted last. So whatever happens in between (a kill, a full
disk), `latest` names a whole checkpoint. Reading one checks every hash: a damaged one is an error, never a fresh start.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from brakeline.errors import CheckpointError, DamagedPart, MissingPart, NoCheckpoint
from brakeline.learner.checkpoint_state import PartState

FORMAT = 1
CHECKPOINT = "checkpoint"  # the folder of a run's checkpoints
LATEST = "latest"
MANIFEST = "manifest.json"
PARTIAL = ".partial"


def exists(root: Path) -> bool:
    return (root / LATEST).exists()


def save(root: Path, parts: dict[str, PartState], about: dict[str, Any]) -> Path:
    """Write `parts` as the latest checkpoint; `about` is what identifies the run (robot, configuration, …).

    Raises:
        CheckpointError: it could not be written; the one before is untouched.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        place = root / f"{_serial(root) + 1:06d}"
        partial = root / PARTIAL
        for leftover in (partial, place):  # of a save that was killed
            shutil.rmtree(leftover, ignore_errors=True)
        partial.mkdir()
        _write(partial, parts, about)
        partial.rename(place)
        pointer = root / (LATEST + ".new")
        pointer.write_text(place.name)
        _sync(pointer)
        pointer.replace(root / LATEST)
    except (OSError, safetensors.SafetensorError) as error:
        shutil.rmtree(root / PARTIAL, ignore_errors=True)
        raise CheckpointError(f"{root}: not written: {error}") from error
    for old in root.iterdir():
        if old.is_dir() and old != place:
            shutil.rmtree(old, ignore_errors=True)
    return place


def load(root: Path, names: tuple[str, ...]) -> tuple[dict[str, PartState], dict[str, Any]]:
    """The latest checkpoint's parts, each of `names` among them, and what was said about it.

    Raises:
        NoCheckpoint, MissingPart, DamagedPart: as they say.
    """
    place = latest(root)
    manifest = _manifest(place)
    parts = {}
    for name in names:
        if name not in manifest["parts"]:
            raise MissingPart(name, place)
        parts[name] = _read(place, name, manifest["parts"][name])
    return parts, manifest["about"]


def _serial(root: Path) -> int:
    try:
        return int(latest(root).name)
    except NoCheckpoint:
        return 0


def latest(root: Path) -> Path:
    """The folder of the latest checkpoint.

    Raises:
        NoCheckpoint: there is none.
        MissingPart: what the pointer names is not there.
    """
    try:
        name = (root / LATEST).read_text().strip()
    except FileNotFoundError:
        raise NoCheckpoint(f"{root}: there is no checkpoint") from None
    if not name.isdecimal() or not (root / name).is_dir():
        raise MissingPart(LATEST, root)
    return root / name


def _write(folder: Path, parts: dict[str, PartState], about: dict[str, Any]) -> None:
    listed = {}
    for name, state in parts.items():
        path = folder / f"{name}.safetensors"
        safetensors.numpy.save_file({key: np.ascontiguousarray(t) for key, t in state.tensors.items()}, path)
        _sync(path)
        listed[name] = {"sha256": _hash(path), "values": state.values}
    path = folder / MANIFEST
    path.write_text(json.dumps({"format": FORMAT, "about": about, "parts": listed}, indent=1, sort_keys=True))
    _sync(path)
    _sync(folder)


def _manifest(place: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((place / MANIFEST).read_text())
    except FileNotFoundError:
        raise MissingPart(MANIFEST, place) from None
    except ValueError as error:
        raise DamagedPart(MANIFEST, place, str(error)) from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not {"about", "parts"} <= manifest.keys():
        raise DamagedPart(MANIFEST, place, f"not of format {FORMAT}")
    return manifest


def _read(place: Path, name: str, entry: dict[str, Any]) -> PartState:
    path = place / f"{name}.safetensors"
    if not path.exists():
        raise MissingPart(name, place)
    if _hash(path) != entry["sha256"]:
        raise DamagedPart(name, place, "its hash is not the manifest's")
    return PartState(safetensors.numpy.load_file(path), entry["values"])


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """On the disk, not only in its cache."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
