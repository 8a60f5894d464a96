"""Law: no pickle anywhere. What crosses a socket, or lies in a file, is plain data in a known format.

Python's own machinery pickles the arguments with which it starts our own processes (`multiprocessing`, spawn); nothing
else does. So no module imports a library that unpickles, and none that uses `multiprocessing` calls `send` or `recv`,
which pickle: a Connection's `send_bytes` and `recv_bytes` do not.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[2]
FOLDERS = (
    *("brakeline", "messaging", "sim", "safety", "actors", "learner", "logs", "deploy", "policies"),
    *("examples", "tests", "benchmarks"),
)
PICKLES = ("pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve")
# `reduction` hands out the pickler, and a manager's proxies pickle over a socket.
PICKLES += ("multiprocessing.reduction", "multiprocessing.managers")
NAMES = ("ForkingPickler", "SyncManager", "BaseManager", "Manager")  # of multiprocessing
CALLS = ("send", "recv")
SUSPECT = re.compile("pickle|dill|joblib|marshal|shelve|multiprocessing|spawning|torch")  # all others need no parser


def pickling(source: str) -> Iterator[str]:
    """Yield a line for each use of pickle in a module."""
    if not SUSPECT.search(source):
        return
    tree = ast.parse(source)
    modules: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    for module in sorted(modules):
        if any(module == name or module.startswith(f"{name}.") for name in PICKLES):
            yield f"import of {module}"
    starts_processes = any(module.split(".")[0] == "multiprocessing" for module in modules)
    starts_processes |= "brakeline.deploy.interpreter.spawning" in modules
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            yield f"allow_pickle in line {node.value.lineno}"
        if isinstance(node, ast.Attribute) and starts_processes and node.attr in (*CALLS, *NAMES):
            yield f".{node.attr} in line {node.lineno}"
        if isinstance(node, ast.Attribute) and node.attr == "load" and ast.unparse(node.value) == "torch":
            yield f"torch.load in line {node.lineno}"


def test_no_module_pickles():
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py")) if ".venv" not in path.parts]
    assert len(paths) > 400, "the whole tree is searched"
    uses = [f"{path.relative_to(ROOT)}: {use}" for path in paths for use in pickling(path.read_text())]
    assert not uses, "\n".join(uses)


@pytest.mark.parametrize(
    "planted",
    [
        "import pickle",
        "def f():\n    from pickle import loads",
        "import cloudpickle as c",
        "import marshal",
        "from dill import dumps",
        "from multiprocessing.reduction import ForkingPickler",
        "from multiprocessing import reduction",
        "from multiprocessing.managers import SyncManager",
        "import multiprocessing\nmultiprocessing.Manager()",
        "from multiprocessing.connection import Connection\ndef f(c: Connection): c.send(1)",
        "from brakeline.deploy.interpreter import spawning\nmine, theirs = spawning().Pipe()\nmine.recv()",
        "import numpy as np\nnp.load('f', allow_pickle=True)",
        "import torch\ntorch.load('f')",
    ],
)
def test_a_planted_pickle_is_found(planted):
    assert list(pickling(planted))


def test_bytes_over_a_pipe_are_allowed():
    assert not list(pickling("from multiprocessing.connection import Connection\ndef f(c): c.send_bytes(b'')"))
