"""No module and no class has the name of another one."""

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = ("actors", "brakeline", "deploy", "learner", "logs", "messaging", "safety", "sim")


def sources() -> list[Path]:
    """Return the package's modules that people write."""
    files = [file for part in PARTS for file in (ROOT / part).rglob("*.py")]  # links are not followed
    return [file for file in files if file.name not in ("__init__.py", "brakeline_pb2.py")]


def repeated(names: list[str]) -> list[str]:
    return sorted(name for name, count in Counter(names).items() if count > 1)


def test_no_module_name_stands_twice():
    assert repeated([file.stem for file in sources()]) == []


def test_no_class_name_stands_twice():
    classes = re.compile(r"^class (\w+)", re.MULTILINE)
    assert repeated([name for file in sources() for name in classes.findall(file.read_text())]) == []
