"""The front door: the names that `brakeline` offers, and what an installed package holds and hides."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

import brakeline
from brakeline.logs.viewer import SCRIPTS, STYLES

ROOT = Path(__file__).parents[2]
# The names, the files and the decisions are tested here, so the kernels of another folder are not compiled: it takes
# 17 s. The long test of `tests/safety/test_kernel_bounds.py` compiles them in a folder of its own.
NOT_COMPILED = {"NUMBA_DISABLE_JIT": "1"}
PARTS = ("messaging", "sim", "safety", "actors", "learner", "logs", "deploy", "robots", "policies")


@pytest.mark.parametrize("name", brakeline.__all__)
def test_every_public_name_can_be_imported(name):
    assert getattr(brakeline, name) is not None


def test_the_table_of_names_is_complete():
    lazy = {name for names in brakeline.PLACES.values() for name in names}
    errors = {name for name in brakeline.__all__ if name in vars(brakeline.errors)}
    assert lazy | errors | {"__version__"} == set(brakeline.__all__)
    with pytest.raises(AttributeError, match="SafetyClient"):
        _ = brakeline.SaftyClient


def test_a_client_imports_no_simulator_and_no_solver():
    heavy = ("mujoco", "torch", "proxsuite", "scipy", "gymnasium", "matplotlib")
    code = (
        "import sys; from brakeline import Obstacle, SafetyClient, robot_named; robot_named('ground'); "
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_a_launcher_imports_no_simulator_and_no_compiled_kernels():
    """It starts with every run, and loads model sets only to check them."""
    heavy = ("mujoco", "torch", "proxsuite", "numba", "scipy", "matplotlib")
    code = f"import sys, brakeline.deploy.run.launcher; print([name for name in {heavy} if name in sys.modules])"
    imported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert imported.stdout.strip() == "[]"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Unpack a wheel in a folder outside the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    words = [sys.executable, "-m", "pip", "wheel", *options, str(ROOT)]
    built = subprocess.run(words, check=False, capture_output=True, text=True)
    if built.returncode:
        pytest.skip(f"no wheel can be built here: {built.stderr.strip().splitlines()[-1]}")
    site = folder / "site"
    zipfile.ZipFile(next(folder.glob("brakeline-*.whl"))).extractall(site)
    return site


@pytest.fixture(scope="module")
def editable(tmp_path_factory):
    """Install the checkout in editable mode in a folder of its own."""
    site = tmp_path_factory.mktemp("editable")
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--target", str(site), "--editable", str(ROOT)]
    words = [sys.executable, "-m", "pip", "install", *options]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"nothing can be installed here: {done.stderr.strip().splitlines()[-1]}")
    return site


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A user's folder whose own modules have the names of our parts."""
    folder = tmp_path_factory.mktemp("crowded")
    (folder / "safety").mkdir()
    for name in PARTS:
        path = folder / "safety" / "__init__.py" if name == "safety" else folder / f"{name}.py"
        path.write_text("MINE = True\n")
    return folder


@pytest.mark.parametrize("install", ["wheel", "editable"])
def test_a_users_own_modules_do_not_shadow_ours(install, crowded, request):
    """From such a folder our package imports its own parts, and the user's imports find the user's modules."""
    site = request.getfixturevalue(install)
    code = (
        f"import site; site.addsitedir({str(site)!r}); site.addsitedir({sysconfig.get_path('purelib')!r}); "
        "from brakeline import Filter, SafetyClient, robot_named; "
        "robot_named('ground'); import messaging, safety, sim; assert messaging.MINE and safety.MINE and sim.MINE; "
        "import brakeline.messaging.robot as ours; print(ours.__file__)"
    )
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    clean |= NOT_COMPILED
    # -S: first the install under test, then the packages that it needs.
    done = subprocess.run(
        [sys.executable, "-S", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=crowded,
        env=clean,
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(site if install == "wheel" else ROOT)


@pytest.mark.parametrize("install", ["wheel", "editable"])
def test_nothing_but_brakeline_is_installed(install, request):
    site = request.getfixturevalue(install)
    names = {path.name.partition("-")[0] for path in site.iterdir() if not path.name.startswith(("__", "bin"))}
    assert names == {"brakeline"}


def outside(wheel: Path, code: str) -> str:
    """Return what code prints that runs with the wheel alone, outside the checkout."""
    run = f"import sys; sys.path.insert(0, {str(wheel)!r}); {code}"
    words, environment = [sys.executable, "-P", "-c", run], os.environ | NOT_COMPILED
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=wheel.parent, env=environment)
    return done.stdout.strip()


def test_a_wheel_has_everything(wheel):
    files = {
        path.relative_to(wheel / "brakeline").as_posix() for path in (wheel / "brakeline").rglob("*") if path.is_file()
    }
    robots = ("ground.toml", "quadrotor.task.toml", "template.txt", "ground.model.safetensors")
    needed = {"py.typed", "policies/ground/trained.safetensors", *(f"robots/{name}" for name in robots)}
    needed |= {"sim/ground.xml", "sim/quadrotor.xml", "deploy/experiments/paper.json", "messaging/brakeline.proto"}
    needed |= {"logs/report_page/report.html.j2", "logs/brakeline.foxglove-layout.json"}
    needed |= {f"logs/viewer/{name}" for name in (*STYLES, *SCRIPTS, "three.LICENSE")}
    assert needed <= files, needed - files
    tracked = subprocess.run(["git", "ls-files", *PARTS], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {p for p in tracked.stdout.split() if p.endswith(".py")} <= files, "a package is missing in pyproject.toml"


def test_the_trained_policies_are_found_outside_the_checkout(wheel):
    code = (
        "from brakeline.deploy.policy_loading import policy_named; "
        "from brakeline.messaging.task import robot_with_task; "
        "[policy_named('trained', robot_with_task(n), 0) for n in ('ground', 'quadrotor')]; "
        "policy_named('trained-by-scan', robot_with_task('ground'), 0); import brakeline; print(brakeline.__file__)"
    )
    assert Path(outside(wheel, code)).is_relative_to(wheel)


def test_the_shipped_model_sets_filter_outside_the_checkout(wheel):
    """A fresh machine with nothing but the package decides, and refuses what hits a wall."""
    code = (
        "from brakeline import Filter, InProcess, Obstacle; import numpy as np; "
        "kinds = []; "
        "ask = lambda robot, state, action, near: InProcess(Filter.load(robot)).decide(state, action, near).kind; "
        "kinds.append(ask('ground', np.zeros(5), [0.2, 0.0], [Obstacle('cylinder', (2.0, 0.0), (0.1,))])); "
        "kinds.append(ask('ground', np.zeros(5), [0.2, 0.0], [Obstacle('cylinder', (0.23, 0.0), (0.1,))])); "
        "kinds.append(Filter.load('quadrotor').robot.name); print(kinds)"
    )
    assert outside(wheel, code) in (f"['allowed', '{kind}', 'quadrotor']" for kind in ("adjusted", "failsafe"))
