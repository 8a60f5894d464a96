"""The front door: the names that `brakeline` offers, and what an installed wheel holds."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import brakeline

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", brakeline.__all__)
def test_every_name_is_there(name):
    assert getattr(brakeline, name) is not None


def test_no_name_is_forgotten():
    offered = {name for names in brakeline.PLACES.values() for name in names}
    assert offered | {"__version__"} == set(brakeline.__all__)
    with pytest.raises(AttributeError, match="SafetyClient"):
        _ = brakeline.SaftyClient


def test_an_asker_needs_no_simulator_and_no_solver():
    heavy = ("mujoco", "torch", "proxsuite", "scipy", "gymnasium", "matplotlib")
    code = (
        "import sys; from brakeline import Obstacle, SafetyClient, robot_named; robot_named('ground'); "
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "[]"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The unpacked wheel, and where to work: nowhere near the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    made = subprocess.run(words, check=False, capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"no wheel can be built here: {made.stderr.strip().splitlines()[-1]}")
    site = folder / "site"
    zipfile.ZipFile(next(folder.glob("brakeline-*.whl"))).extractall(site)
    return site


def outside(wheel: Path, code: str) -> str:
    """What code prints that runs with the wheel alone, outside the checkout."""
    run = f"import sys; sys.path.insert(0, {str(wheel)!r}); {code}"
    words = [sys.executable, "-P", "-c", run]
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=wheel.parent).stdout.strip()


def test_a_wheel_has_everything(wheel):
    files = {path.relative_to(wheel).as_posix() for path in wheel.rglob("*") if path.is_file()}
    for needed in (
        *("brakeline/py.typed", "robots/ground.toml", "robots/quadrotor.task.toml", "robots/template.txt"),
        *("policies/ground/trained.safetensors", "sim/ground.xml", "sim/quadrotor.xml", "deploy/study/paper.json"),
        *("logs/page/report.html.j2", "logs/brakeline.foxglove-layout.json", "messaging/brakeline.proto"),
    ):
        assert needed in files, needed
    python = {p for p in files if p.endswith(".py")}
    packages = ("brakeline", "messaging", "sim", "safety", "actors", "learner", "logs", "deploy", "robots")
    tracked = subprocess.run(["git", "ls-files", *packages], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {p for p in tracked.stdout.split() if p.endswith(".py")} <= python, "a package is missing in pyproject.toml"


def test_the_trained_policies_are_found_outside_the_checkout(wheel):
    code = (
        "from deploy.policies import policy_named; from messaging.tasks import robot_with_task; import messaging; "
        "[policy_named('trained', robot_with_task(n), 0) for n in ('ground', 'quadrotor')]; "
        "policy_named('trained-by-scan', robot_with_task('ground'), 0); print(messaging.__file__)"
    )
    assert Path(outside(wheel, code)).is_relative_to(wheel)
