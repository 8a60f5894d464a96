import itertools
import json
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np
import pytest

from brakeline.errors import CheckpointError
from brakeline.learner import checkpoint
from brakeline.learner.checkpoint import PartState
from tests.faults.failing_calls import Died, failing, full
from tests.full_disk import full_disk
from tests.fuzz.mutations import flipped

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


def test_a_checkpoint_of_an_earlier_version_says_so_and_what_to_do(tmp_path):
    """Its manifest had no hash."""
    folder = save(tmp_path, 3)
    text = (folder / "manifest.json").read_text().replace('"format": 2', '"format": 1')
    (folder / "manifest.json").write_text(text)
    (folder / "manifest.sha256").unlink()
    with pytest.raises(CheckpointError, match=r"earlier version of Brakeline.*format 1.*--from-logs RUN"):
        number_in(tmp_path)


def names(root: Path) -> list[str]:
    return sorted(path.name for path in root.iterdir())


def test_round_trip_and_of_checkpoints_only_the_latest_stays(tmp_path):
    assert not checkpoint.exists(tmp_path)
    for name in ("backup", "000001.mine", "12"):
        (tmp_path / name).mkdir()
    for number in (1, 2, 3):
        save(tmp_path, number)
        assert number_in(tmp_path) == number
    assert names(tmp_path) == ["000001.mine", "000003", "12", "backup", "latest"] and checkpoint.exists(tmp_path)


BIG, MANIFEST = "big.safetensors", "manifest.json"
DAMAGES = [
    *((BIG, data, "big") for data in (lambda b: b[:-1], lambda b: b[:500] + b"?" + b[501:], lambda b: b"", None)),
    *((MANIFEST, lambda b, text=text: text, "manifest") for text in (b"", b"[]", b"{")),
    (MANIFEST, lambda b: json.dumps({"format": 99, "about": {}, "parts": {}}).encode(), "manifest"),
    (MANIFEST, None, "manifest.json"),
    (BIG, lambda b: b, "other"),  # which was never saved
]


@pytest.mark.parametrize(("file", "damage", "part"), DAMAGES)
def test_damaged_and_missing_files_are_named(tmp_path, file, damage, part):
    path = save(tmp_path, 1) / file
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(checkpoint.DamagedPart, match=f"part '{part}"):
        checkpoint.load(tmp_path, (*NAMES, "other"))


@pytest.mark.parametrize("file", ["manifest.json", "manifest.sha256", "small.safetensors"])
def test_no_flipped_bit_is_restored(tmp_path, file):
    path = save(tmp_path, 1) / file
    whole, random = path.read_bytes(), Random(0)
    for _ in range(300):
        path.write_bytes(flipped(whole, random.randrange(len(whole)), random.randrange(8)))
        with pytest.raises(checkpoint.DamagedPart):
            checkpoint.load(tmp_path, NAMES)
    path.write_bytes(whole)
    assert number_in(tmp_path) == 1


def test_no_flipped_bit_of_latest_leads_to_a_fresh_start(tmp_path):
    save(tmp_path, 1)
    path = tmp_path / "latest"
    whole = path.read_bytes()
    for place, bit in itertools.product(range(len(whole)), range(8)):
        path.write_bytes(flipped(whole, place, bit))
        assert checkpoint.exists(tmp_path)
        with suppress(checkpoint.DamagedPart):
            assert number_in(tmp_path) == 1


def test_a_wrong_or_lost_pointer_and_a_lost_folder_are_no_fresh_start(tmp_path):
    save(tmp_path, 1)
    latest = tmp_path / "latest"
    for text in ("000009", "", "../000001"):
        latest.write_text(text)
        with pytest.raises(checkpoint.DamagedPart, match="latest"):
            checkpoint.load(tmp_path, NAMES)
    latest.unlink()
    assert checkpoint.exists(tmp_path) and number_in(tmp_path) == 1
    assert save(tmp_path, 2).name == "000002" and number_in(tmp_path) == 2
    (tmp_path / "000002").rename(tmp_path / "moved")
    assert checkpoint.exists(tmp_path)
    for call in (lambda: checkpoint.load(tmp_path, NAMES), lambda: save(tmp_path, 3)):
        with pytest.raises(checkpoint.DamagedPart, match="latest"):
            call()
    assert names(tmp_path) == ["latest", "moved"]


def test_full_disk_leaves_the_one_before(tmp_path):
    save(tmp_path, 1)
    with full_disk(20_000), pytest.raises(checkpoint.CheckpointError, match="not written"):
        save(tmp_path, 2)
    assert number_in(tmp_path) == 1
    assert names(tmp_path) == ["000001", "latest"]
    save(tmp_path, 3)
    assert number_in(tmp_path) == 3


@pytest.mark.parametrize("error", [Died, full])
@pytest.mark.parametrize("before", [0, 1])
def test_a_kill_or_a_full_disk_at_any_call_leaves_a_whole_checkpoint(tmp_path, before, error):
    failed = set()
    for at in itertools.count():
        root = tmp_path / str(at)
        if before:
            save(root, 1)
        with failing(root, at, error) as disk, suppress(Died, checkpoint.CheckpointError):
            save(root, 2)
        if len(disk.seen) <= at:
            break
        failed.add(disk.seen[at])
        if before or checkpoint.exists(root):
            assert number_in(root) in (before, 2)
        save(root, 3)
        assert number_in(root) == 3
        assert len(names(root)) == 2, disk.seen
    assert {"open", "write", "fsync", "mkdir", "rename", "replace"} <= failed


def test_state_says_what_does_not_fit():
    state = PartState({"rows": np.zeros((2, 3), np.float32)}, {"count": 2, "flag": True})
    assert state.tensor("rows", (None, 3), "float32") is state.tensors["rows"]
    for name, shape, kind in (("rows", (2, 4), "float32"), ("rows", (6,), "float32"), ("rows", (2, 3), "float64")):
        with pytest.raises(ValueError, match="rows"):
            state.tensor(name, shape, kind)
    for name in ("flag", "other"):
        with pytest.raises(ValueError, match=name):
            state.integer(name)
