"""Law: every reference to docs/method.md names a section that it has.

A reference is the word "method", with or without path and suffix, and one or several section signs with numbers: lists
and ranges count number by number. On the page itself a section sign alone refers to the page.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[2]
PAGE = Path("docs/method.md")
SUFFIXES = (".md", ".py", ".toml", ".proto", ".yml", ".yaml", ".js", ".ts", ".c", ".h", ".sh")
SKIPPED = ("site", "runs", "build", "dist", "node_modules", "__pycache__")

HEADING = re.compile(r"^## (\d+)\. \S", re.MULTILINE)
ONE = r"§+\s?\d+(?:\s?[-–]\s?§?\d+)?"
LIST = rf"{ONE}(?:(?:,|,?\s(?:and|or|to))[\s#]*{ONE})*"
ON_OTHER_FILES = re.compile(rf"\bmethod(?:\.md)?[`)\],:]*[\s#]*({LIST})", re.IGNORECASE)
ON_THE_PAGE = re.compile(rf"({LIST})")
RANGE = re.compile(r"(\d+)(?:\s?[-–]\s?§?(\d+))?")


def sections(page: str) -> list[int]:
    """Return the numbers of a page's numbered headings."""
    return [int(number) for number in HEADING.findall(page)]


def references(text: str, pattern: re.Pattern[str] = ON_OTHER_FILES) -> Iterator[tuple[int, int]]:
    """Yield line and section number of each reference."""
    for reference in pattern.finditer(text):
        line = text.count("\n", 0, reference.start()) + 1
        for first, last in RANGE.findall(reference.group(1)):
            for number in range(int(first), int(last or first) + 1):
                yield line, number


def texts(root: Path) -> Iterator[Path]:
    """Yield the code, tests and pages of a tree, relative to it."""
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if name not in SKIPPED and not name.startswith("."))
        yield from (Path(folder, name).relative_to(root) for name in sorted(names) if name.endswith(SUFFIXES))


def unresolved(root: Path) -> list[str]:
    """Return a line for each reference in a tree that names no section of its docs/method.md."""
    known = set(sections((root / PAGE).read_text()))
    return [
        f"{path}:{line}: docs/method.md has no §{number}"
        for path in texts(root)
        for line, number in references((root / path).read_text(), ON_THE_PAGE if path == PAGE else ON_OTHER_FILES)
        if number not in known
    ]


def test_sections_are_numbered_in_order() -> None:
    numbers = sections((ROOT / PAGE).read_text())
    assert numbers == list(range(1, 16)), "code cites sections by number: add sections at the end, remove none"


def test_every_reference_resolves() -> None:
    cited = [path for path in texts(ROOT) if path != PAGE and any(references((ROOT / path).read_text()))]
    assert len(cited) > 10, "the whole tree is searched"
    assert not unresolved(ROOT)


@pytest.mark.parametrize(
    ("planted", "found"),
    [
        ('"""Free space (method §{})."""', [13]),
        ('"""Free space (docs/method.md §{})."""', [13]),
        ("# see `docs/method.md` §{}", [13]),
        ("see method, §{}", [13]),
        ("# by docs/method.md\n# §{}", [13]),
        ("(docs/method.md §1, §{})", [13]),
        ("docs/method.md §1 and §{}", [13]),
        ("Method §11-§{}", [13]),
        ("docs/method.md §12–{}", [13]),
        ("[method](method.md) §{}", [13]),
        ("(method §3, §8-§10)", []),
        ("another page's §{}", []),
    ],
)
def test_a_planted_reference_is_found(tmp_path: Path, planted: str, found: list[int]) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / PAGE).write_text("".join(f"## {k}. Section\n\nSee §{k}.\n\n" for k in range(1, 13)))
    (tmp_path / "planted.py").write_text(planted.format(13))
    assert [line.rpartition("§")[2] for line in unresolved(tmp_path)] == [str(number) for number in found]


def test_a_wrong_reference_on_the_page_is_found(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / PAGE).write_text("## 1. Model sets\n\nThe tube (§2) uses it.\n")
    assert unresolved(tmp_path) == ["docs/method.md:3: docs/method.md has no §2"]
