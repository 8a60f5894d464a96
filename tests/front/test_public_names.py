"""The front door: the names that `brakeline` offers, what an installed package holds, and what needs no extra."""

import copy
import inspect
import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

import brakeline
from brakeline import errors
from brakeline.extras import EXTRAS
from brakeline.logs.viewer import SCRIPTS, STYLES
from brakeline.messaging import brakeline_pb2 as pb

ROOT = Path(__file__).parents[2]
# The names, the files and the decisions are tested here, so the kernels of another folder are not compiled: it takes
# 17 s. The long test of `tests/safety/test_kernel_bounds.py` compiles them in a folder of its own.
NOT_COMPILED = {"NUMBA_DISABLE_JIT": "1"}
PARTS = ("messaging", "sim", "safety", "actors", "learner", "logs", "deploy", "robots", "policies")


def printed(code: str, *options: str, **more) -> str:
    """Return what code prints in an interpreter of its own."""
    words = [sys.executable, *options, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **({"cwd": ROOT} | more))
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_table_of_names_is_complete():
    lazy = {name for names in brakeline.PLACES.values() for name in names}
    errors = {name for name in brakeline.__all__ if name in vars(brakeline.errors)}
    assert lazy | errors | {"__version__"} == set(brakeline.__all__)
    with pytest.raises(AttributeError, match="SafetyClient"):
        _ = brakeline.SaftyClient


EXCEPTIONS = [one for one in vars(errors).values() if inspect.isclass(one) and issubclass(one, errors.BrakelineError)]
ARGUMENTS = {  # by annotation
    "str": "state",
    "str | InvalidField": "state",
    "Path": Path("part"),
    "pb.Error": pb.Error(type="BadRequest", field="state", message="why"),
    "Sequence[tuple[str, str]]": [("field", "mistake")],
    "dict[str, str]": {"column": "why"},
}


@pytest.mark.parametrize("kind", EXCEPTIONS)
def test_an_exception_reaches_another_process_as_it_is(kind):
    """By the same protocol as a copy. `multiprocessing.Pool` waited for ever for a `BadRequest` of a worker."""
    own = inspect.signature(kind).parameters.values() if inspect.isfunction(kind.__init__) else ()
    error = kind(*(ARGUMENTS[one.annotation] for one in own)) if own else kind("why")
    error.add_note("in episode 3")
    for other in (copy.copy(error), copy.deepcopy(error)):
        assert type(other) is kind and str(other) == str(error) and vars(other) == vars(error)


@pytest.mark.parametrize("kind", [errors.BadRequest, errors.BadShape, errors.StaleModel])
def test_an_exception_that_gymnasium_raises_anew_says_the_same(kind):
    """`AsyncVectorEnv` raised `TypeError: missing 1 required positional argument` in its place."""
    error = kind("state", "state has another shape")
    again = kind(error)
    assert (str(again), again.field) == (str(error), error.field)


CLIENT = "from brakeline import Obstacle, SafetyClient, robot_named; robot_named('ground')"
LAUNCHER = "import brakeline.deploy.run.launcher"  # it starts with every run, and loads model sets only to check them


@pytest.mark.parametrize(("code", "other"), [(CLIENT, "gymnasium"), (LAUNCHER, "numba")], ids=["client", "launcher"])
def test_a_client_and_a_launcher_import_no_simulator_no_solver_and_no_compiled_kernels(code, other):
    heavy = ("mujoco", "torch", "proxsuite", "scipy", "matplotlib", other)
    assert printed(f"{code}; import sys; print([name for name in {heavy} if name in sys.modules])") == "[]"


@pytest.mark.parametrize("code", ["import gymnasium, brakeline", "import brakeline.envs, gymnasium"])
def test_an_import_registers_the_environments(code):
    """In either order. `tests/sim/test_navigation_env.py` makes them by their names."""
    names = {"brakeline/Ground-v0", "brakeline/Quadrotor-v0"}
    assert printed(f"{code}; print({names} <= gymnasium.registry.keys())") == "True"


def pip(*words: str) -> None:
    """Run pip on the checkout, or skip the test where it cannot build."""
    options = ["--quiet", "--no-deps", "--no-build-isolation"]
    done = subprocess.run([sys.executable, "-m", "pip", *words, *options], check=False, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"nothing can be built here: {done.stderr.strip().splitlines()[-1]}")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Unpack a wheel in a folder outside the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--wheel-dir", str(folder), str(ROOT))
    site = folder / "site"
    zipfile.ZipFile(next(folder.glob("brakeline-*.whl"))).extractall(site)
    return site


@pytest.fixture(scope="module")
def editable(tmp_path_factory):
    """Install the checkout in editable mode in a folder of its own."""
    site = tmp_path_factory.mktemp("editable")
    pip("install", "--target", str(site), "--editable", str(ROOT))
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
    ours = Path(printed(code, "-S", cwd=crowded, env=clean))
    assert ours.is_relative_to(site if install == "wheel" else ROOT)
    names = {path.name.partition("-")[0] for path in site.iterdir() if not path.name.startswith(("__", "bin"))}
    assert names == {"brakeline"}, "nothing else is installed"


def outside(wheel: Path, code: str) -> str:
    """Return what code prints that runs with the wheel alone, outside the checkout."""
    run = f"import sys; sys.path.insert(0, {str(wheel)!r}); {code}"
    return printed(run, "-P", cwd=wheel.parent, env=os.environ | NOT_COMPILED)


def test_a_wheel_has_everything(wheel):
    files = {
        path.relative_to(wheel / "brakeline").as_posix() for path in (wheel / "brakeline").rglob("*") if path.is_file()
    }
    robots = ("ground.toml", "quadrotor.task.toml", "template.txt", "ground.model.safetensors")
    needed = {"py.typed", "policies/ground/trained.safetensors", *(f"robots/{name}" for name in robots)}
    needed |= {"sim/ground.xml", "sim/quadrotor.xml", "deploy/experiments/paper.json", "messaging/brakeline.proto"}
    needed |= {"logs/report_page/report.html.j2", "logs/report_page/main.js", "logs/brakeline.foxglove-layout.json"}
    needed |= {f"logs/viewer/{name}" for name in (*STYLES, *SCRIPTS, "three.LICENSE")}
    assert needed <= files, needed - files
    tracked = subprocess.run(["git", "ls-files", *PARTS], capture_output=True, text=True, check=True, cwd=ROOT)
    assert {p for p in tracked.stdout.split() if p.endswith(".py")} <= files, "a package is missing in pyproject.toml"


def test_the_package_runs_the_command_line(tmp_path):
    words = [sys.executable, "-P", "-m", "brakeline", "--version"]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.startswith("brakeline ")


def test_the_shipped_model_sets_and_policies_work_outside_the_checkout(wheel):
    """A fresh machine with nothing but the package decides, and refuses what hits a wall."""
    code = """
import numpy as np
import brakeline
from brakeline import Filter, InProcess, Obstacle
from brakeline.deploy.policy_loading import policy_named
from brakeline.messaging.task import robot_with_task
ask = InProcess(Filter.load("ground"))
for x in (2.0, 0.23):
    print(ask.decide(np.zeros(5), [0.2, 0.0], [Obstacle("cylinder", (x, 0.0), (0.1,))]).kind)
print(Filter.load("quadrotor").robot.name)
for policy, robot in (("trained", "ground"), ("trained", "quadrotor"), ("trained-by-scan", "ground")):
    policy_named(policy, robot_with_task(robot), 0)
print(brakeline.__file__)
"""
    far, near, robot, place = outside(wheel, code).split("\n")
    assert far == "allowed" and near in ("adjusted", "failsafe") and robot == "quadrotor"
    assert Path(place).is_relative_to(wheel)


# Blocks what extras bring, as if it were not installed.
BLOCKER = f"""
import sys

class Without:
    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted({package for packages in EXTRAS.values() for package in packages})}:
            return None
        return self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Without, sys.meta_path)
"""


def test_every_public_name_every_help_and_every_completion_need_no_extra():
    code = """
import brakeline
for name in brakeline.__all__:
    assert getattr(brakeline, name) is not None
from brakeline.deploy.cli import COMMANDS, main
asked = [[command, "--help"] for command in COMMANDS]
others = ["train", "--help-all"], ["completion", "bash"], ["completion", "zsh"], ["--version"], ["--help"]
for words in (*asked, *others):
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    assert not code, words
print("all")
"""
    assert printed(BLOCKER + code).endswith("all")


def test_a_log_of_ones_own_names_its_extra():
    code = """
from brakeline import Filter, InProcess, RecordedClient
RecordedClient(InProcess(Filter.load("ground")), "nowhere")
"""
    with pytest.raises(AssertionError, match=r"pip install 'brakeline\[logs\]'"):
        printed(BLOCKER + code, env=os.environ | NOT_COMPILED)
    assert not Path("nowhere").exists()


@pytest.mark.parametrize(
    ("words", "extras"),
    [
        ("collect ground", "sim"),
        ("evaluate", "sim,logs"),
        ("train ground --steps 100", "sim,train,logs"),
        ("fly --policy learn", "sim,mavlink,logs,train"),
        ("fly", "sim,mavlink,logs"),
        ("ros2 --connect tcp/127.0.0.1:1", "ros2"),
        ("bridge-sim", "sim,ros2"),
        ("autopilot", "sim,mavlink"),
        ("watch", "logs"),
        ("analyse", "logs"),
    ],
)
def test_all_missing_extras_of_a_command_are_named_at_once_with_their_command(words, extras, tmp_path):
    code = BLOCKER + f"from brakeline.deploy.cli import main\nsys.exit(main({words.split()}))"
    env = os.environ | NOT_COMPILED | {"PYTHONPATH": str(ROOT)}
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, check=False, capture_output=True, text=True, cwd=tmp_path, env=env)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert f"pip install 'brakeline[{extras}]'" in done.stderr, done.stderr


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
