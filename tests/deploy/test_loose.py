"""Test that no command uses a model set whose stated bound is above the robot's limit, unless you accept the bound."""

import contextlib
import io
import json
import shutil
from dataclasses import replace

import pytest

from brakeline.deploy.cli import main
from brakeline.messaging.robot_description import read_robot
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_set import ModelSet


@pytest.fixture(scope="module")
def few(few_data, tmp_path_factory):
    """A data folder with some minutes of driving."""
    folder = tmp_path_factory.mktemp("few")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BRAKELINE_DATA", str(folder))
        (folder / "ground").mkdir()
        shutil.copy(few_data, folder / "ground" / "record.safetensors")
        yield folder


CERTIFY = ("certify", "ground", "--certificates", "residual", "--mode", "direct", "--use")


@pytest.fixture(scope="module")
def certified(few):
    """The figures of `certify --use` with an accepted bound, and `file`: the model set that it writes."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert main([*CERTIFY, "--accept-bound", "0.5", "--json"]) == 0
    return json.loads(output.getvalue()) | {"file": model_of(few).read_bytes()}


@pytest.fixture
def loose(certified, few):
    """That model set, in use."""
    model_of(few).write_bytes(certified["file"])


def model_of(folder):
    return folder / "ground" / "residual-direct.safetensors"


def test_certify_use_refuses_a_loose_model_set_and_writes_nothing(few, command):
    model_of(few).unlink(missing_ok=True)
    status, out, err = command(*CERTIFY, "--json")
    assert status == 1 and not model_of(few).exists()
    assert "not put to use" in err and "limit of ground is 1 %" in err and "--accept-bound 0." in err
    figures = json.loads(out)["residual"]
    assert figures["bound_plan"] > 0.01 and "--accept-bound" in figures["not_used"]


def test_certify_use_writes_a_model_set_with_an_accepted_bound(certified, few):
    assert ModelSet.load(model_of(few)).about["bound_plan"] == f"{certified['residual']['bound_plan']:.6g}"
    assert certified["residual"]["in_use"] == str(model_of(few)), "the path that a program loads"


def test_certify_makes_a_model_set_in_real_time_of_a_file_and_lets_more_plans_leave_it(
    few, tmp_path, monkeypatch, command, figures
):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    data = Dataset.load(few / "ground" / "record.safetensors")
    replace(data, trajectories=data.trajectories[:10]).save(tmp_path / "fewer.safetensors")
    words = ("certify", "ground-late", "--data", tmp_path / "fewer.safetensors", "--accept-bound", "0.5")
    strict, lenient = (
        figures(*words, "--use", "--outside", outside)["residual"]["one-step"] for outside in ("0.001", "0.1")
    )
    assert ModelSet.load(tmp_path / "ground-late" / "residual-one-step.safetensors").robot.name == "ground-late"
    assert all(lenient[name] < strict[name] for name in ("inflation", "half_width_rest"))
    assert all(lenient[name] > strict[name] for name in ("bound_plan", "marginal"))
    status, _, err = command("certify", "ground", "--outside", "0.5")
    assert status == 1 and "between 0 and 0.1" in err and not (tmp_path / "ground").exists()


@pytest.mark.parametrize(
    "words",
    [
        "safety ground --listen tcp/127.0.0.1:0",
        "evaluate ground --episodes 1 --policy random",
        "train ground --steps 300 --out {out}",
        "ros2 ground --seconds 1",
    ],
)
def test_each_command_that_drives_refuses_a_loose_model_set(words, loose, command, tmp_path):
    status, _, err = command(*words.format(out=tmp_path / "run").split())
    assert status == 1, err
    assert "of plans leave their tubes" in err and "is 1 %" in err and "--accept-bound 0." in err
    assert not (tmp_path / "run").exists()


def test_evaluate_uses_a_model_set_with_an_accepted_bound(loose, command):
    words = ("evaluate", "ground", "--episodes", 1, "--policy", "random", "--json")
    assert command(*words, "--accept-bound", 0.5)[0] == 0
    status, _, err = command(*words, "--accept-bound", 0.001)
    assert status == 1 and "--accept-bound accepts is 0.1 %" in err
    status, _, err = command(*words, "--accept-bound", 2)
    assert status == 1 and "above 0 and at most 1" in err


@pytest.mark.parametrize("bound", [None, "nan", "a few"])
def test_a_model_set_without_a_readable_bound_is_refused(bound, loose, few, command):
    model = ModelSet.load(model_of(few))
    model.about.pop("bound_plan")
    model.about.update({} if bound is None else {"bound_plan": bound})
    model.save(model_of(few))
    words = ("evaluate", "ground", "--episodes", 1, "--policy", "random", "--accept-bound", 0.99)
    status, _, err = command(*words)
    assert status == 1 and "any share may leave their tubes" in err and "--accept-bound 1 " in err


def test_a_description_can_set_its_own_limit(tmp_path):
    text = (ROBOTS_FOLDER / "ground.toml").read_text()
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace('name = "ground"', 'name = "mine"\naccept_bound = 0.05'))
    robot = read_robot(mine)
    assert robot.accept_bound == 0.05 and robot.description["accept_bound"] == 0.05
    assert robot.in_real_time().accept_bound == 0.05
    (tmp_path / "plain.toml").write_text(mine.read_text().replace("accept_bound = 0.05\n", ""))
    plain = read_robot(tmp_path / "plain.toml")
    assert plain == robot and plain.layout() == robot.layout(), "it says nothing about vectors"
    assert plain.accept_bound == 0.01 and "accept_bound" not in plain.description


@pytest.mark.parametrize("damaged", [False, True])
def test_a_vehicle_behind_a_link_is_not_flown_with_a_model_set_of_the_simulator(
    damaged, tmp_path, monkeypatch, command
):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    file = tmp_path / "quadrotor-late" / "residual-one-step.safetensors"
    if damaged:
        file.parent.mkdir()
        file.write_bytes(b"damaged")
    words = ("fly", "--url", "udpin:127.0.0.1:14999", "--accept-bound", "1", "--out", tmp_path / "run")
    status, _, err = command(*words)
    assert status == 1 and "no model set of this vehicle" in err and "collect quadrotor --url" in err
    assert not (tmp_path / "quadrotor").exists() and not (tmp_path / "run").exists()
    assert not damaged or file.read_bytes() == b"damaged"
