"""Files that are there whole or not at all, whoever else writes them."""

import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from brakeline.messaging.atomic_files import write_atomically, write_secret


def test_of_many_who_write_at_once_the_whole_of_one_stays(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "file"
    payloads = [bytes([number]) * 100_000 for number in range(16)]
    with ThreadPoolExecutor(8) as pool:
        for _ in range(10):
            list(pool.map(lambda payload: write_atomically(path, payload), payloads))
            assert path.read_bytes() in payloads
    assert list(path.parent.iterdir()) == [path]


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"before")

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="no space left"):
        write_atomically(path, b"after")
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link_and_its_target_is_written(tmp_path: Path) -> None:
    """Such as a file on a shared volume. A secret replaces the link, which somebody else may have put there."""
    (tmp_path / "shared").mkdir()
    for name in ("there", "new"):
        (tmp_path / name).symlink_to(Path("shared") / name)
    (tmp_path / "shared" / "there").write_bytes(b"before")
    for name in ("there", "new"):
        write_atomically(tmp_path / name, b"after")
        assert (tmp_path / name).is_symlink() and (tmp_path / "shared" / name).read_bytes() == b"after"
    write_secret(tmp_path / "there", b"secret")
    assert not (tmp_path / "there").is_symlink() and (tmp_path / "shared" / "there").read_bytes() == b"after"


def test_a_secret_is_its_owners_also_where_it_was_not_before(tmp_path: Path) -> None:
    path = tmp_path / "keys" / "secret"
    write_atomically(path, b"everybody's")
    assert stat.S_IMODE(path.stat().st_mode) & 0o044
    write_secret(path, b"mine")
    assert path.read_bytes() == b"mine" and stat.S_IMODE(path.stat().st_mode) == 0o600
