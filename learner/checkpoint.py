"""Checkpoints: the whole state of a learner on disk.

A checkpoint is a folder, `<root>/000042/`. It holds one safetensors file for each part, and `manifest.json` with the
hash of each file and the plain values of the parts. The function `save` writes a folder `.partial`, renames it, and
replaces the one-line file `latest` atomically. It deletes older checkpoints last. A kill or a full disk at any moment
therefore leaves `latest` at a whole checkpoint. The function `load` verifies every hash.
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

from brakeline.errors import CheckpointError, DamagedPart
from brakeline.learner.checkpoint_state import PartState

FORMAT = 1
CHECKPOINT = "checkpoint"  # the folder of a run's checkpoints
LATEST = "latest"
MANIFEST = "manifest.json"
PARTIAL = ".partial"


def exists(root: Path) -> bool:
    """Return whether there is a checkpoint."""
    return (root / LATEST).exists()


def save(root: Path, parts: dict[str, PartState], about: dict[str, Any]) -> Path:
    """Write the latest checkpoint, and return its folder.

    Args:
        about: identifies the run (robot, configuration, …).

    Raises:
        CheckpointError: the checkpoint could not be written; the previous one is unchanged.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        place = root / f"{int(latest(root).name) + 1 if exists(root) else 1:06d}"
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
    """Return the named parts of the latest checkpoint, and what `save` got as `about`.

    Raises:
        CheckpointError: there is no checkpoint.
        DamagedPart: a part is missing or damaged.
    """
    place = latest(root)
    manifest = _manifest(place)
    return {name: _read(place, name, manifest["parts"].get(name)) for name in names}, manifest["about"]


def latest(root: Path) -> Path:
    """Return the folder of the latest checkpoint.

    Raises:
        CheckpointError: there is no checkpoint.
        DamagedPart: `latest` names a folder that does not exist.
    """
    try:
        name = (root / LATEST).read_text().strip()
    except FileNotFoundError:
        raise CheckpointError(f"{root}: there is no checkpoint") from None
    if not name.isdecimal() or not (root / name).is_dir():
        raise DamagedPart(LATEST, root, "missing")
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
        raise DamagedPart(MANIFEST, place, "missing") from None
    except ValueError as error:
        raise DamagedPart(MANIFEST, place, f"damaged: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not {"about", "parts"} <= manifest.keys():
        raise DamagedPart(MANIFEST, place, f"not of format {FORMAT}")
    return manifest


def _read(place: Path, name: str, entry: dict[str, Any] | None) -> PartState:
    path = place / f"{name}.safetensors"
    if entry is None or not path.exists():
        raise DamagedPart(name, place, "missing")
    if _hash(path) != entry["sha256"]:
        raise DamagedPart(name, place, "damaged: its hash is not the one in the manifest")
    return PartState(safetensors.numpy.load_file(path), entry["values"])


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
