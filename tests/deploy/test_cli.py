"""Test the command line: errors and JSON."""

import errno
import io
import json
import os
import re
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest
from rich.console import Console

from brakeline import Filter, InProcess
from brakeline.deploy import progress
from brakeline.deploy.cli import COMMANDS, command_class, main, reason
from brakeline.deploy.commands import certify_command
from brakeline.deploy.commands.certify_command import CertifyCommand, unrecorded, validation_table
from brakeline.deploy.commands.common_options import Method
from brakeline.deploy.commands.pretrain_command import PretrainCommand
from brakeline.deploy.commands.query_command import OBSTACLE_FORMS, load_scan, parse_obstacle, plan_table, proposal
from brakeline.deploy.data.description_summary import remarks, unmeasured_holds
from brakeline.deploy.experiments.compared_methods import METHODS
from brakeline.errors import BadScan, Untrusted
from brakeline.logs.figure_tables import analyse
from brakeline.logs.run_groups import METHOD_COLORS
from brakeline.logs.segment import open_segment
from brakeline.messaging.obstacle import Obstacle
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.robot import robot_named
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.messaging.scan import Scan
from brakeline.messaging.stated_share import percent
from brakeline.safety import methods
from brakeline.safety.model import model_config
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.validation import ValidationReport
from brakeline.safety.service.signature import SignedModel
from tests.deploy.data.porter import FILE, drive, write_csv
from tests.robots import QUADROTOR
from tests.waiting import until

SHARED = {
    *("episodes", "goals", "collisions", "timeouts", "steps", "interventions", "failsafes", "mean_speed", "max_speed"),
    *("mean_reward", "decision_ms", "containment", "method", "certificate", "policy", "arena", "seed"),
}
STATED = {
    *("samples", "rank", "condition", "windows", "violations", "bound_step", "bound_plan"),
    *("half_width_rest", "half_width_full"),
}


@pytest.mark.parametrize(
    "words, said",
    [
        ("safety ground --listen nonsense", "'nonsense' is no endpoint: give PROTOCOL/HOST:PORT"),
        ("recorder {folder}/x.mcap --listen smoke/signals", "smoke/signals is open to other machines"),
        ("train ground --listen tls/127.0.0.1 --out {folder}/run", "invalid socket address"),
        ("actor ground --listen tcp/127.0.0.1:0 --arena ballroom", "there are: crossing, default"),
        ("train ground --arena ballroom --out {folder}/run", "no arena is called 'ballroom'; there are: crossing"),
        ("train ground --method none --listen tls/127.0.0.1:0 --out {folder}/run", "give a port, or leave it out"),
        ("train ground --method none --metrics 0 --out {folder}/run", "use the next ports, so give 1 to 65531"),
        ("train ground --method none --metrics 65535 --out {folder}/run", "use the next ports, so give 1 to 65531"),
        ("train submarine --out {folder}/run", "no robot is called 'submarine'; there are: ground"),
        ("train ground --from-logs {folder}/none --out {folder}/run", "no log at"),
        ("train ground --resume {folder}/none", "is no run's configuration"),
        ("train ground --deterministic --robots-per-actor 2", "one actor with one robot"),
        ("train ground --actors 0", "1 or more"),
        ("train ground --experiment sleep", "there are: default, demo, debug"),
        ("evaluate submarine", "there are: ground"),
        ("evaluate ground --arena ballroom", "there are: crossing, default, dense"),
        ("evaluate ground --policy [bold]", "no policy is called '[bold]' and no such file exists; there are: trained"),
        ("analyse {folder}/none", "no log at"),
        (f"analyse {FILE}", "is not an MCAP file"),
        (f"certify --data {FILE}", "`brakeline import` reads CSV"),
        ("import", "there is no log to import"),
        ("compare ground --table --results {folder}/none", "none: there are no results of ground"),
        ("robot new {folder}/none/my.toml", "none/my.toml': make the folder"),
        ("robot check ground --map v=speed", "--from, --map, --unit and --topics are for `robot new`, not for check"),
        ("robot new {folder}/my.toml --unit v=km/h", "--unit v=km/h: these options are for reading a log; name it"),
        ("certify --data {folder}/none.mcap", "no log at"),
        ("certify --data nothere.safetensors", "no data set at nothere.safetensors"),  # it is not recorded anew
        ("query ground --connect tcp/127.0.0.1:1 --obstacle ball", "an obstacle is: cylinder X Y RADIUS"),
        ("query quadrotor --connect tcp/127.0.0.1:1 --obstacle ball", "an obstacle is: cylinder X Y Z RADIUS HEIGHT"),
        ("query ground --connect tcp/127.0.0.1:1 --scan {folder}/none", "none"),
        ("status", "no run at runs/latest: give --connect tls/HOST:PORT"),
        ("query ground --known-free", "no run at runs/latest"),
        ("safety ground --listen tcp/0.0.0.0:7447", "is open to other machines: give --keys FOLDER"),
        ("query ground --known-free --connect tcp/127.0.0.1:1 --keys {folder}", "with keys a bus is at tls/HOST:PORT"),
        ("query ground --known-free --connect tls/127.0.0.1:1", "give --keys FOLDER, or set BRAKELINE_KEYS"),
        ("query ground --known-free --connect tls/127.0.0.1:1 --keys {folder}", "ca.pem is missing: no keys of client"),
        ("keys {folder}/keys bob", "'bob' begins with no role"),
        ("keys {folder}/none --sign {folder}/none", "no key to sign models with"),
    ],
)
def test_an_impossible_command_fails_with_one_line_that_says_why(
    command, data_folder, tmp_path, monkeypatch, words, said
):
    monkeypatch.chdir(tmp_path)
    status, out, err = command(*words.format(folder=tmp_path).split())
    assert (status, out) == (1, "") and said in err and err.startswith("brakeline ")
    assert err.count("\n") == 1 and not {path.name for path in tmp_path.iterdir()} - {"run"}
    assert not (tmp_path / "run" / "logs").exists()


@pytest.fixture
def read_only(monkeypatch):
    """`read_only(folder)`: as if the file system of a folder were mounted read-only; root may write anywhere else."""

    def protect(folder):
        def protected(function, writes):
            def call(path, *words, **more):
                if not isinstance(path, int) and writes(*words, **more):
                    inside = Path(os.fsdecode(path)).absolute().is_relative_to(folder)
                    if inside and not Path(path).is_char_device():
                        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
                return function(path, *words, **more)

            return call

        changes = os.O_WRONLY | os.O_RDWR | os.O_CREAT
        monkeypatch.setattr(os, "mkdir", protected(os.mkdir, lambda *_, **__: True))
        monkeypatch.setattr(os, "open", protected(os.open, lambda flags, *_, **__: bool(flags & changes)))
        monkeypatch.setattr(io, "open", protected(io.open, lambda mode="r", *_, **__: mode[0] != "r" or "+" in mode))

    return protect


WRITING = ("robot new my.toml", "import {log} --robot {robot}", "collect ground", "certify ground", "keys keys router")


@pytest.mark.parametrize("words", [*WRITING, "train ground --steps 100"])
def test_a_read_only_folder_is_an_error_that_says_where_to_write(command, monkeypatch, tmp_path, read_only, words):
    monkeypatch.delenv("BRAKELINE_DATA", raising=False)
    log, folder = tmp_path / "drive.csv", tmp_path / "checkout"
    folder.mkdir()
    if "{log}" in words:
        write_csv(log, *drive(seconds=30.0))
    monkeypatch.chdir(folder)
    read_only(folder)
    status, out, err = command(*words.format(log=log, robot=FILE).split())
    assert status == 1 and "Read-only file system" in err, out + err
    assert "folder in which you may write" in err and "BRAKELINE_DATA" in err and not [*folder.iterdir()]


def test_a_file_without_permission_is_an_error_for_reading_and_for_writing():
    text = reason(PermissionError(errno.EACCES, os.strerror(errno.EACCES), "secret.mcap"))
    assert "Permission denied: 'secret.mcap'. To read it" in text and "folder in which you may write" in text


def test_a_full_disk_is_an_error_that_says_what_to_do():
    text = reason(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert "No space left on device. Free some space, or name a place on another disk: BRAKELINE_DATA" in text


@pytest.mark.parametrize("words", ["train --method prayer", "evaluate --certificate hope", "certify --mode loud"])
def test_a_wrong_choice_is_answered_with_the_possible_ones(command, words):
    status, out, err = command(*words.split())
    assert (status, out) == (2, "") and "invalid choice" in err


def test_a_run_that_could_not_listen_can_be_started_again(command, data_folder, tmp_path):
    for _ in range(2):
        status, _, err = command(
            "train", "--experiment", "debug", "--out", tmp_path / "run", "--listen", "tcp/127.0.0.1:x", "--no-secured"
        )
        assert status == 1 and "cannot listen" in err


def test_an_obstacle_is_parsed_from_words():
    assert parse_obstacle(("cylinder", "0.4", "0", "0.1"), 2) == Obstacle("cylinder", (0.4, 0.0), (0.1,))
    assert parse_obstacle(("box", "1", "2", "0.3", "0.4", "0.5"), 2) == Obstacle("box", (1.0, 2.0), (0.3, 0.4), 0.5)
    assert parse_obstacle(("wall", "1", "0", "3.14"), 2) == Obstacle("wall", (1.0, 0.0), (), 3.14)
    for wrong in ((), ("pond", "1", "2"), ("cylinder", "1", "2"), ("box", "1", "2", "x", "4")):
        with pytest.raises(ValueError, match="an obstacle is"):
            parse_obstacle(wrong, 2)


@pytest.mark.parametrize("dim", OBSTACLE_FORMS)
def test_an_obstacle_is_parsed_in_each_form_that_the_error_names(dim):
    for form in OBSTACLE_FORMS[dim].split(" | "):
        kind, *names = form.replace("[YAW]", "YAW").split()
        assert parse_obstacle((kind, *["0.5"] * len(names)), dim).kind == kind
        with pytest.raises(ValueError, match=re.escape(OBSTACLE_FORMS[dim])):
            parse_obstacle((kind, "0.5"), dim)


def test_collect_is_reproducible_by_its_seed(figures, tmp_path):
    words = ("collect", "--trajectories", 1, "--out")
    printed = [figures(*words, tmp_path / f"{i}", "--seed", seed) for i, seed in enumerate("556")]
    assert printed[0]["digest"] == printed[1]["digest"] != printed[2]["digest"]
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()
    assert (printed[0]["trajectories"], printed[0]["periods"]) == (2, 420) and printed[0]["about"]["seed"] == "5"


def test_certify_refuses_too_little_data_with_status_1(command, figures, tmp_path):
    figures("collect", "--trajectories", 2, "--out", tmp_path / "few.safetensors")
    words = ("certify", "--data", tmp_path / "few.safetensors", "--mode", "direct", "--certificates", "residual")
    status, out, err = command(*words, "--json")
    assert status == 1 and "at least" in err
    assert "refused" in json.loads(out)["residual"]
    assert "encoder ticks" not in command(*words)[1], "the conditions need --verbose"


def test_certify_refuses_data_of_another_robot_than_the_named_one(command, tmp_path):
    """It certified the recorded robot, and put that to use, whatever body the named description had."""
    still, inputs = np.zeros(QUADROTOR.state_dim), np.zeros((9, QUADROTOR.action_dim))
    drive = Trajectory(np.tile(still, (10, 1)), inputs, np.zeros((9, 1, 3)), np.zeros(9))
    Dataset(QUADROTOR, (drive,), {}).save(tmp_path / "data.safetensors")
    status, _, err = command("certify", FILE, "--data", tmp_path / "data.safetensors", "--use")
    assert status == 1 and "has data of quadrotor, not of porter: certify quadrotor, or import the log" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--windows free", "--windows is for --mode direct and recursion: leave that out"),
        ("--mode direct --outside 0.01", "--outside is for mode one-step: leave that out"),
        ("--mode direct --last 100", "--last is for logs: leave that out"),
    ],
)
def test_certify_refuses_options_that_would_do_nothing(command, few_data, words, said):
    status, _, err = command("certify", "--data", few_data, *words.split())
    assert status == 1 and said in " ".join(err.split())


def test_certify_says_with_which_options_commands_load_a_model_set(command, few_data, tmp_path, monkeypatch):
    """Without them, they load another one: the line sounded as if it were this one."""
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "my data"))
    words = ("certify", "--data", few_data, "--certificates", "residual", "--accept-bound", 1, "--use", "--mode")
    status, page, err = command(*words, "recursion")
    assert status == 0 and "in use from now on by commands with --mode recursion; without that, they load" in page, err
    assert "other commands refuse this model set unless" in page, "its bound is above the robot's own limit"
    monkeypatch.setattr(certify_command, "refusal", lambda *_: "")
    status, page, err = command(*words, "direct")
    assert status == 0 and "residual-direct.safetensors: in use from now on\n" in page, err
    assert "other commands refuse" not in page, "a larger --accept-bound than needed changes nothing"


def test_certify_states_each_error_bound_in_json_in_words_and_with_its_conditions(
    command, figures, few_data, monkeypatch
):
    monkeypatch.setattr(progress, "FIRST", 0.01)
    words = ("certify", "--data", few_data, "--mode", "direct")
    bounds = figures(*words)
    for name in ("residual", "set-membership", "matrix-zonotope"):
        assert bounds[name].keys() >= STATED
        assert bounds[name]["violations"] <= bounds[name]["windows"] and 0 < bounds[name]["bound_step"] < 0.1
        assert 0 < bounds[name]["half_width_rest"] <= bounds[name]["half_width_full"] < 0.1
    s = bounds["residual"]
    assert s["outside_hour"] == pytest.approx(18_000 * s["bound_step"])
    status, page, err = command(*words, "--certificates", "residual", "--verbose")
    assert status == 0 and "{" not in page and "certifying" in err and ": 0 of 100" in err
    for text in (
        f"residual, direct, in words, at 99% confidence, from {s['windows']} held-out plans",
        f"at most {percent(s['bound_step'])} of steps leave their predicted set ({s['step_violations']} did)",
        f"at most {percent(s['bound_plan'])} of plans leave their tube ({s['violations']} did)",
        f"an episode of 300 steps (60 s): at most {300 * s['bound_step']:.2g} steps outside on average",
        f"at least one in up to {percent(s['bound_episode'])} of episodes, if steps are independent",
        f"an hour of driving (18,000 steps): at most {s['outside_hour']:,.0f} steps outside on average",
        "encoder ticks",
    ):
        assert text in page


def test_evaluate_and_analyse_share_their_keys(figures, data_folder, tmp_path):
    words = ("evaluate", "ground", "--policy", "random", "--episodes", 1, "--arena", "dense", "--seed")
    evaluated, same, other = (figures(*words, seed) for seed in (4, 4, 5))
    assert evaluated.keys() >= SHARED
    assert (evaluated["arena"], evaluated["seed"], evaluated["policy"]) == ("dense", 4, "random")
    assert evaluated["containment"].keys() == {"steps", "violations"}
    times = [printed.pop("decision_ms") for printed in (evaluated, same, other)]
    assert times[0].keys() == {"mean", "std", "p50", "p99", "allowed", "adjusted", "failsafe", "recovering"}
    assert evaluated == same and evaluated["mean_reward"] != other["mean_reward"]
    assert [time is None for time in times[0].values()] == [time is None for time in times[1].values()]
    open_segment(tmp_path / "empty.mcap", {}).finish()
    assert figures("analyse", tmp_path / "empty.mcap").keys() >= SHARED
    assert analyse(tmp_path / "empty.mcap")["steps"] == 0


def test_evaluate_without_a_filter_has_no_times(figures):
    evaluated = figures("evaluate", "--policy", "greedy", "--method", "none", "--episodes", 1)
    assert (evaluated["decision_ms"], evaluated["certificate"], evaluated["interventions"]) == (None, None, 0)
    assert evaluated["containment"] == {"steps": 0, "violations": 0}


@pytest.mark.parametrize("columns", [60, 80, 160])
def test_the_validation_table_is_complete_at_any_width(columns):
    """Also of a recursion that diverges."""
    counts = {"samples": 1000, "rank": 6, "windows": 300, "violations": 0, "step_violations": 0}
    bounds = {"bound_step": 0.01, "bound_plan": 0.02, "bound_episode": 0.951}
    bounds |= {"outside_episode": 3.0, "outside_hour": 179.2}
    sizes = {"half_width_rest": 0.0012, "half_width_full": 149810.138, "clearance_margin": 1.5, "excess": 0.8}
    about = {"certificate": "matrix-zonotope", "mode": "recursion", "version": "a"}
    report = ValidationReport(**counts, **bounds, **sizes, **about, smallest_singular=1.0, condition=12.0)
    file = io.StringIO()
    console = Console(file=file, width=columns, force_terminal=True, color_system=None, soft_wrap=True)
    other = replace(report, half_width_full=float("nan"), certificate="residual")
    console.print(validation_table([(report, "plan"), (other, "free")]))
    shown = file.getvalue()
    assert "…" not in shown and max(map(len, shown.splitlines())) <= columns
    words = ("certificate", "matrix-zonotope", "≤ per plan", "2 %", "≤ per episode", "96 %", "≤ 180 steps", "1.5 m")
    assert [word for word in words if word not in shown] == []
    assert shown.count("diverges") == 2 and "149810" not in shown and "1.2 mm" in shown


def test_certify_says_which_inputs_were_not_recorded():
    ground = ModelSet.load("ground")
    assert unrecorded(ground) == ""
    fast = replace(ground, robot=replace(ground.robot, name="fast", action_high=(1.0, 0.5)))
    said = "the filter verifies recorded inputs alone: command speed from 0 to 0.255 m/s (26 % of its range)"
    assert unrecorded(fast) == said


def test_an_input_that_a_stop_holds_and_nobody_measures_is_told(capsys):
    """The filter may then verify nothing, and the robot stands there."""
    ground = robot_named("ground")
    held = replace(ground, stop=("ramp", "hold"), follows=(3, -1))
    assert unmeasured_holds(ground) == unmeasured_holds(replace(held, follows=(3, 4))) == ""
    assert any("no state measures turn rate" in remark for remark in remarks(held))
    for robot, told in ((ground, False), (held, True)):
        CertifyCommand()._print([], [], SimpleNamespace(robot=robot))
        assert ("no state measures turn rate, which a stop holds" in capsys.readouterr().out) == told


def test_only_the_innermost_of_nested_work_prints_its_progress(monkeypatch, capsys):
    monkeypatch.setattr(progress, "FIRST", 0.01)
    monkeypatch.setattr(progress, "AGAIN", 0.01)
    monkeypatch.setattr(progress, "console", Console(stderr=True, force_terminal=False))
    output = ""

    def printed(word):
        nonlocal output
        output += capsys.readouterr().err
        return word in output

    with progress.under_way("driving", 3), progress.under_way("recording"):
        until(lambda: printed("recording"))
        time.sleep(0.1)
        printed("")
    assert "driving" not in output.partition("recording")[2]
    with progress.under_way("driving", 3), progress.under_way("recording"):
        pass
    output = ""
    with progress.under_way("driving", 3):
        until(lambda: printed("driving: 0 of 3"))
    assert not progress.UNDER_WAY


def test_a_plan_is_shown_with_its_tube_and_without_one_if_there_is_none():
    """The rivals predict no tube."""
    safety = InProcess(Filter.load("ground"))
    answer = safety.decide(np.zeros(5), [0.2, 0.0], known_free=True)
    nothing = np.zeros((0, 2))
    for shown, columns in ((answer, 5), (replace(answer, tube_center=nothing, tube_half_width=nothing), 3)):
        table = plan_table(shown, safety.robot.action)
        assert (len(table.columns), table.row_count) == (columns, len(answer.plan))


def test_a_scan_is_loaded_from_a_file(tmp_path):
    def read(dim, text):
        (tmp_path / "seen.json").write_text(text)
        return load_scan(tmp_path / "seen.json", dim)

    scan = read(2, '{"ranges": [1, null, 0], "angles": [0, 0.1, 0.2], "pose": [1, 2, 0], "doubt": 1}')
    assert isinstance(scan, Scan) and scan.valid_beams.tolist() == [True, False, False]
    assert (scan.doubt, scan.far) == (1, 3.5)
    image = read(3, json.dumps({"ranges": np.ones((45, 90)).tolist(), "at": [0, 0, 1]}))
    assert isinstance(image, RangeImage) and image.ranges.shape == (45, 90)
    for dim, text, said in (
        (2, "{", "not a Scan: not JSON: Expecting property name"),
        (2, "[]", "a JSON object of ranges, angles, pose"),
        (2, '{"ranges": [1], "angels": [0]}', "a JSON object of ranges, angles, pose"),
        (2, '{"ranges": [1], "angles": [0]}', "missing 1 required positional argument: 'pose'"),
        (2, '{"ranges": ["far"], "angles": [0], "pose": [0, 0, 0]}', "could not convert"),
        (2, '{"ranges": [-1], "angles": [0], "pose": [0, 0, 0]}', "0 or more"),
        (3, '{"ranges": [[1], [1, 2]], "at": [0, 0, 0]}', "inhomogeneous"),
        (3, '{"ranges": [1], "angles": [0], "pose": [0, 0, 0]}', "a JSON object of ranges, at, attitude"),
    ):
        with pytest.raises(BadScan, match=said):
            read(dim, text)


def test_every_method_of_the_service_can_be_chosen_and_named_in_a_configuration():
    assert get_args(Method) == (*methods.METHODS, "none")
    assert model_config.METHODS == methods.METHODS
    rivals = get_type_hints(PretrainCommand)["method"]
    assert get_args(rivals) == tuple(methods.RIVALS) and METHODS.keys() <= METHOD_COLORS.keys()


# --- `brakeline robot` -------------------------------------------------------------------------------------------


def test_a_command_that_a_message_names_can_be_pasted_into_a_shell(command, tmp_path):
    """Folders have names with spaces, too."""
    (folder := tmp_path / "my robots").mkdir()
    path = folder / "rover.toml"
    for words in (("robot", "new", path), ("robot", "new", path), ("robot", "check", path)):
        _, out, err = command(*words)
        assert f"'{path}'" in (out + err).replace("\n", ""), words
    with pytest.raises(Untrusted, match=f"--sign '{path}'"):
        SignedModel.load(path)


@pytest.mark.parametrize("words", [("{log}", "{csv}"), ("{csv}", "{log}"), ("{log}", "--unit", "v=km/h")])
def test_a_new_description_from_a_run_takes_nothing_else(command, log, tmp_path, words):
    """The second log and the options were ignored in silence."""
    drive_csv = write_csv(tmp_path / "drive.csv", *drive(seconds=10.0))
    places = (word.format(log=log, csv=drive_csv) for word in words)
    status, _, err = command("robot", "new", tmp_path / "my.toml", "--from", *places)
    assert status == 1 and "give one such log alone, without --map" in err and not (tmp_path / "my.toml").exists()


def test_a_new_description_has_no_mistake_and_check_lists_every_one(command, figures, tmp_path):
    path = tmp_path / "rover.toml"
    status, out, _ = command("robot", "new", path)
    assert status == 0 and f"robot check {path}" in out.replace("\n", "") and 'name = "rover"' in path.read_text()
    status, out, _ = command("robot", "check", path)
    assert status == 0 and "no mistake" in out and "collect" not in out, "nothing simulates it"
    assert "brakeline collect ground" in command("robot", "check", "ground")[1]
    status, _, err = command("robot", "new", path)
    assert status == 1 and "exists" in err
    new = path.read_text()
    (remark,) = figures("robot", "check", path)["remarks"]
    assert remark.startswith("body: one disc of 0.2 m around the position, as in the template."), "nobody measured it"
    path.write_text(new.replace("radius = 0.2", "radius = 0.3"))
    assert not figures("robot", "check", path)["remarks"]
    path.write_text(new.replace("sight = 3.0", "sight = 0.2"))
    assert any(remark.startswith("sight") for remark in figures("robot", "check", path)["remarks"])
    path.write_text(re.sub(r"(?m)^(x = .*error = )[\d.]+", r"\g<1>3.0", new))
    assert any("an error of 3 m" in remark for remark in figures("robot", "check", path)["remarks"]), "millimetres"
    limit = '\n[[limit]]\nname = "{}"\nweights = {{ speed = {} }}\nmost = {}\n'
    for text, told in ((limit.format("slow", 1.0, 0.3), False), (limit.format("fast", -1.0, -0.1), True)):
        path.write_text(new + text)
        assert told == any(remark.startswith("limit") for remark in figures("robot", "check", path)["remarks"])
    path.write_text(new.replace("brake = 3", "brakes = 3").replace('"m/s"', '"km/h"', 1))
    status, _, err = command("robot", "check", path)
    assert status == 1 and "plan.brakes: unknown; did you mean 'brake'?" in err and "state.speed.unit" in err
    status, out, _ = command("robot", "check", path, "--json")
    assert status == 1
    assert {"plan.brakes", "plan.brake", "state.speed.unit"} <= {field for field, _ in json.loads(out)["problems"]}


def test_check_names_an_arena_without_room_and_what_to_change(command, tmp_path):
    """It found no mistake, and `train` gave up minutes later."""
    path = tmp_path / "rover.toml"
    path.write_text((ROBOTS_FOLDER / "ground.toml").read_text().replace('name = "ground"', 'name = "rover"'))
    task = (ROBOTS_FOLDER / "ground.task.toml").read_text()
    path.with_name("rover.task.toml").write_text(task)
    assert command("robot", "check", path)[0] == 0
    path.with_name("rover.task.toml").write_text(re.sub(r"path_clearance = .*", "path_clearance = 3.0", task, count=1))
    status, _, err = command("robot", "check", path)
    assert status == 1 and "arenas.default: none of 1000" in err and "path_clearance (3 m)" in " ".join(err.split())


@pytest.mark.parametrize("robot", ["ground", "quadrotor"])
def test_show_prints_a_description(command, figures, robot):
    shown = figures("robot", "show", robot)
    assert shown["name"] == robot and shown["footprint_m"] in (0.105, 0.3)
    assert {one["slew"] for one in shown["inputs"].values()} == {{"ground": None, "quadrotor": 0.8}[robot]}
    assert shown["horizon"] == {"ground": 3, "quadrotor": 12}[robot]
    out = command("robot", "show", robot)[1]
    assert "[m/s]" in out and "layout" in out and shown["way_to_a_stop_m"] > 0.0


def test_show_prints_how_far_the_body_reaches_from_the_position(command, figures, tmp_path):
    """An odometry's point ahead of the middle, with the discs behind it or ahead of it, looked the same."""
    path = tmp_path / "cart.toml"
    assert command("robot", "new", path)[0] == 0
    path.write_text(path.read_text().replace("at = [0.0, 0.0]", "at = [0.4, -0.1]"))
    shown = figures("robot", "show", path)
    reach = [shown[f"body_{side}_m"] for side in ("ahead", "behind", "to_the_left", "to_the_right")]
    np.testing.assert_allclose(reach, [0.6, -0.2, 0.1, 0.3], atol=1e-12)
    assert "body to the left [m]" in command("robot", "show", path)[1]
    assert "body_ahead_m" not in figures("robot", "show", "quadrotor")


def test_the_way_to_a_stop_is_not_known_if_no_input_is_a_speed(command, figures):
    car = Path(__file__).parents[2] / "examples" / "bullet_safety_gym" / "racecar.toml"
    assert figures("robot", "show", car)["way_to_a_stop_m"] is None
    assert re.search(r"way to a stop[^\n]*:? +not known", command("robot", "show", car)[1])


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("excite --seed -1", "--seed is a number from 0 on, not -1"),
        ("demo --seed -1", "--seed is a number from 0 on, not -1"),
        ("pretrain secas --seed -1", "--seed is a number from 0 on, not -1"),
        ("excite --minutes 0", "--minutes is a number above 0, not 0"),
        ("certify --last 0", "--last is a number from 1 on, not 0"),
        ("import a.csv --hold 0", "--hold is a number above 0, not 0"),
        ("import a.csv --delay nan", "--delay is a number from -1e+09 to 1e+09, not nan"),
        ("import a.csv --out .", "--out . is a folder: give the path of a file"),
        ("fly --minutes nan", "--minutes is a number above 0, not nan"),
        ("autopilot --vehicles -1", "--vehicles is a number from 1 on, not -1"),
        ("autopilot --setpoint-timeout nan", "--setpoint-timeout is a number above 0, not nan"),
        ("bridge-sim --timeout inf", "--timeout is a number above 0, not inf"),
        ("train --deadline nan --out runs/none", "--deadline is a number from -1e+09 to 1e+09, not nan"),
        ("train --practice -1 --out runs/none", "practice = -1.0 is not 0 or more"),
        ("ros2 ground --free-at-start -1", "--free-at-start is a number from 0 on, not -1"),
        ("evaluate ground --payload 1e99", "--payload is a number from -1e+09 to 1e+09, not 1e+99"),
        (
            "evaluate ground --episodes 10000000000000000000000",
            "--episodes is a number from -1e+09 to 1e+09, not 1e+22",
        ),
        ("train --learner.td3.multiplier-rate 1e30", "--learner.td3.multiplier-rate is a number from"),
        ("fly --origin 0 0 -1e30", "--origin is a number from"),
        ("evaluate ground --episode 3", "--episode chooses the episode to draw: give --render FILE too"),
        ("evaluate ground --render a.png --episode -3", "--episode is a number from 0 on, not -3"),
        ("status --wait -1", "--wait is a number from 0 on, not -1"),
    ],
)
def test_a_number_that_makes_no_sense_is_refused_in_a_sentence(words, why, capsys):
    assert main(words.split()) == 1
    assert why in " ".join(capsys.readouterr().err.split())


def test_every_number_that_is_checked_is_an_option():
    for name in COMMANDS:
        command = command_class(name)
        checked = {**getattr(command, "least", {}), **getattr(command, "above", {})}
        assert set(checked) <= set(get_type_hints(command)), name


def test_a_query_without_an_action_says_what_it_proposes():
    inputs = ("speed [m/s]", "turn rate [rad/s]")
    given = proposal(inputs, (0.25, 0.0), given=True)
    assert given == "proposed speed 0.25 m/s, turn rate 0 rad/s"
    assert proposal(inputs, (0.25, 0.0), given=False) == f"{given} (the highest inputs; propose others with --action)"
