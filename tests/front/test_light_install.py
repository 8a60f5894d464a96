"""An installation without extras filters in process and asks a service. Anything else names the extra it needs."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from brakeline.extras import EXTRAS

ROOT = Path(__file__).parents[2]
# Blocks what extras bring, as if it were not installed.
BLOCKER = f"""
import importlib.abc, sys

class NotInstalled(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted({package for packages in EXTRAS.values() for package in packages})}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NotInstalled())
"""


def light(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in an interpreter that has no extra."""
    words = [sys.executable, "-c", BLOCKER + code]
    return subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT)


def test_every_public_name_is_there_and_the_service_and_its_questions_need_no_extra():
    code = """
import brakeline
for name in brakeline.__all__:
    assert getattr(brakeline, name) is not None
from brakeline.deploy.cli import main
for command in ("safety", "query", "status", "router", "keys"):
    try:
        code = main([command, "--help"])
    except SystemExit as end:
        code = end.code
    assert not code, command
print("all")
"""
    done = light(code)
    assert done.stdout.endswith("all\n"), done.stderr


def test_a_missing_extra_is_named_with_its_command():
    done = light("from brakeline.deploy.cli import main\nsys.exit(main(['collect', 'ground']))")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert re.search(r"pip install .brakeline\[(sim|logs)\]", done.stderr)


def test_the_table_of_extras_is_that_of_the_package():
    """The names that are imported, against the names that are installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = {
        "foxglove-sdk": "foxglove",
        "Jinja2": "jinja2",
        "mcap-protobuf-support": "mcap_protobuf",
        "minari[hdf5]": "minari",
    }
    for extra, packages in EXTRAS.items():
        listed = project["optional-dependencies"][extra]
        assert sorted(packages) == sorted(installed.get(name, name.replace("-", "_")) for name in listed), extra
