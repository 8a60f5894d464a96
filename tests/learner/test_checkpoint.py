import json
import resource
from pathlib import Path

import numpy as np
import pytest

from brakeline.learner import checkpoint
from brakeline.learner.checkpoint_state import PartState

NAMES = ("big", "small")


def parts(number: int) -> dict[str, PartState]:
    big = np.full((1000, 50), number, np.float32)
    return {
        "big": PartState({"rows": big[:, ::2]}, {}),
        "small": PartState({}, {"number": number, "huge": 2**100 + number}),
    }


def number_in(root: Path) -> int:
    states, about = checkpoint.load(root, NAMES)
    number = states["small"].integer("number")
    assert (states["big"].tensor("rows", (1000, 25), "float32") == number).all()
    assert states["small"].integer("huge") == 2**100 + number
    assert about == {"robot": "toy"}
    return number


def save(root: Path, number: int) -> Path:
    return checkpoint.save(root, parts(number), {"robot": "toy"})


def test_round_trip_and_only_the_latest_stays(tmp_path):
    assert not checkpoint.exists(tmp_path)
    for number in (1, 2, 3):
        save(tmp_path, number)
        assert number_in(tmp_path) == number
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000003", "latest"]
    assert checkpoint.exists(tmp_path)


def test_missing_parts_are_named(tmp_path):
    place = save(tmp_path, 1)
    with pytest.raises(checkpoint.DamagedPart) as caught:
        checkpoint.load(tmp_path, (*NAMES, "other"))
    assert caught.value.part == "other"
    (place / "big.safetensors").unlink()
    with pytest.raises(checkpoint.DamagedPart) as caught:
        checkpoint.load(tmp_path, NAMES)
    assert caught.value.part == "big"
    (place / "manifest.json").unlink()
    with pytest.raises(checkpoint.DamagedPart, match=r"manifest\.json"):
        checkpoint.load(tmp_path, NAMES)


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b[:500] + b"?" + b[501:], lambda b: b""])
def test_damaged_parts_are_named(tmp_path, damage):
    path = save(tmp_path, 1) / "big.safetensors"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(checkpoint.DamagedPart) as caught:
        checkpoint.load(tmp_path, NAMES)
    assert caught.value.part == "big"


@pytest.mark.parametrize("text", ["", "[]", "{", json.dumps({"format": 99, "about": {}, "parts": {}})])
def test_damaged_manifest(tmp_path, text):
    (save(tmp_path, 1) / "manifest.json").write_text(text)
    with pytest.raises(checkpoint.DamagedPart, match="manifest"):
        checkpoint.load(tmp_path, NAMES)


def test_a_pointer_to_nothing_is_no_fresh_start(tmp_path):
    save(tmp_path, 1)
    for text in ("000009", "", "../000001"):
        (tmp_path / "latest").write_text(text)
        with pytest.raises(checkpoint.DamagedPart, match="latest"):
            checkpoint.load(tmp_path, NAMES)


def test_full_disk_leaves_the_one_before(tmp_path):
    save(tmp_path, 1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))  # as on a full disk, the write itself fails
    try:
        with pytest.raises(checkpoint.CheckpointError, match="not written"):
            save(tmp_path, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert number_in(tmp_path) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000001", "latest"]
    save(tmp_path, 3)
    assert number_in(tmp_path) == 3


@pytest.mark.parametrize("killed_in", ["_write", "rename", "write_text", "replace", "iterdir"])
def test_killed_at_any_point_a_whole_one_is_there(tmp_path, monkeypatch, killed_in):
    save(tmp_path, 1)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint if killed_in == "_write" else Path, killed_in, killed)
        save(tmp_path, 2)
    assert number_in(tmp_path) == (2 if killed_in == "iterdir" else 1)
    place = save(tmp_path, 3)
    assert number_in(tmp_path) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == [place.name, "latest"]


def test_state_says_what_does_not_fit():
    state = PartState({"rows": np.zeros((2, 3), np.float32)}, {"count": 2, "flag": True})
    assert state.tensor("rows", (None, 3), "float32") is state.tensors["rows"]
    for name, shape, kind in (("rows", (2, 4), "float32"), ("rows", (6,), "float32"), ("rows", (2, 3), "float64")):
        with pytest.raises(ValueError, match="rows"):
            state.tensor(name, shape, kind)
    for name in ("flag", "other"):
        with pytest.raises(ValueError, match=name):
            state.integer(name)
