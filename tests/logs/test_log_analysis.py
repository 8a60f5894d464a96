"""All figures equal those of an independent reader; several logs; memory that does not grow."""

import json
import re
import shutil
import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from brakeline.logs.episode_sampler import MOST_STEPS, SPREAD
from brakeline.logs.figure_tables import analyse, show, show_episode
from brakeline.logs.learning_curve import MOST_BINS, LearningCurve, interventions_in
from brakeline.logs.log_analysis import AnalysisOptions, LogAnalysis, RunAnalysis, analyse_runs
from brakeline.logs.log_export import to_foxglove
from brakeline.logs.process_timeline import MOST_BINS as MOST_TIMES
from brakeline.logs.process_timeline import ProcessTimeline
from brakeline.logs.reader import Log, by_run, find, read
from brakeline.logs.segment import open_segment
from brakeline.messaging import brakeline_pb2 as pb
from tests.logs.sample_log import (
    ABOUT,
    BEGIN,
    SECOND,
    Writer,
    agree,
    counted,
    decoded,
    least_clearance,
    mixed,
    once,
    printed,
)

Two = tuple[list[dict[str, Any]], dict[str, Any]]
Messages = list[tuple[str, Any]]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mixed(tmp_path_factory.mktemp("logs") / "mixed")


@pytest.fixture(scope="module")
def messages(log: Path) -> Messages:
    """The log's messages by another reader, with those that are there twice."""
    return decoded(find(log))


@pytest.fixture(scope="module")
def analysis(log: Path) -> LogAnalysis:
    return analyse_runs(log, AnalysisOptions(pictures=True, episode=3))


@pytest.fixture(scope="module")
def figures(analysis: LogAnalysis) -> dict[str, Any]:
    return analysis.figures()


def test_every_figure_agrees_with_a_count_by_another_reader(figures: dict[str, Any], messages: Messages) -> None:
    expected = counted(messages)
    agree({name: figures[name] for name in expected}, expected)
    lost = sum(topic["missing"] for topic in figures["topics"].values())
    twice = sum(topic["duplicates"] for topic in figures["topics"].values())
    assert lost > 20 and twice > 20 and figures["collisions"] > 5 and figures["no_decision"]["Late"] > 5


def test_robots_and_actors_add_up(figures: dict[str, Any]) -> None:
    assert set(figures["robots"]) == {"ground", "quadrotor"}
    for part in (figures["robots"], figures["actors"]):
        for name in ("steps", "episodes", "goals", "collisions", "interventions"):
            assert sum(row[name] for row in part.values()) == figures[name], name


def test_training_rates_are_those_of_the_steps_in_each_bin(figures: dict[str, Any], messages: Messages) -> None:
    steps = [m for key, m in once(messages) if key.startswith("step/ground")]
    training = figures["training"]["ground"]
    for row in training["bins"]:
        own = steps[row["until"] - row["steps"] : row["until"]]
        assert row["adjusted"] == pytest.approx(sum(s.decision == 2 and not s.fallback for s in own) / len(own))
        assert row["failsafes"] == pytest.approx(sum(s.fallback or s.decision == 3 for s in own) / len(own))
        assert row["episodes"] == sum(s.terminated or s.truncated for s in own)
        assert row["closest"] == min(map(least_clearance, own))
    assert training["bins"][-1]["until"] == len(steps)
    collisions = sum(row["collisions"] for row in training["bins"])
    assert collisions == figures["robots"]["ground"]["collisions"], "also of an episode whose end is lost"
    ended = [step for step in steps if step.terminated or step.truncated]
    last = training["last"]
    assert last["episodes"] == min(100, len(ended)) > 20
    assert last["goals"] == pytest.approx(sum(step.goal for step in ended[-100:]) / last["episodes"])
    newest, behind = 0, []
    for key, message in once(messages):
        if key == "metrics/ground" or key.startswith("step/ground"):
            newest = max(newest, message.weights_version)
        if key.startswith("step/ground"):
            behind.append(newest - message.weights_version)
    assert training["staleness"]["mean"] == pytest.approx(sum(behind) / len(behind))
    assert training["staleness"]["max"] == max(behind) > 0


def test_a_resumed_run_is_one_run_and_its_pause_is_not_counted(figures: dict[str, Any]) -> None:
    assert [Path(path).name for path in figures["log"]] == ["run.mcap", "run_0001.mcap"]
    assert list(figures["runs"]) == ["mixed"]
    first, last = (figures["segments"][place][edge] for place, edge in ((0, "start"), (1, "end")))
    assert last - first > 100.0 > figures["seconds"] > 1.0
    actor = figures["processes"]["actor-1"]
    assert (actor["starts"], actor["ended"]) == (2, "alive at the end of the log")
    assert figures["processes"]["actor-0"]["ended"] == "in order"
    assert figures["metadata"]["configuration"] == {"steps": 12}
    assert figures["metadata"]["model ground"] == ABOUT["model ground"] and figures["seed"] == 7


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Two:
    """The figures of two runs, each by itself, and of both."""
    folder = tmp_path_factory.mktemp("two")
    folders = [mixed(folder / "one", 5, 8), mixed(folder / "two", 6, 8, later=1e4)]
    return [analyse(folder) for folder in folders], analyse(folders)


def test_runs_are_labelled_and_merged(two: Two) -> None:
    single, both = two
    assert list(both["runs"]) == ["one", "two"]
    for name in ("steps", "episodes", "goals", "collisions", "timeouts", "interventions"):
        assert both[name] == sum(figures[name] for figures in single), name
        assert [run[name] for run in both["runs"].values()] == [figures[name] for figures in single]
    driven = sum(f["mean_speed"] * f["steps"] for f in single)
    assert both["mean_speed"] == pytest.approx(driven / both["steps"])
    assert "one/actor-0" in both["actors"] and "two/actor-0" in both["processes"]
    assert (both["seed"], both["metadata"]["run"]) == (7, ABOUT["run"])
    messages = [run["messages"] for figures in single for run in figures["runs"].values()]
    assert [run["messages"] for run in both["runs"].values()] == messages


def test_an_actor_is_found_in_several_runs_with_and_without_the_run_in_its_name(tmp_path: Path) -> None:
    folders = [mixed(tmp_path / "one", 5, 8), mixed(tmp_path / "two", 6, 8)]
    for actor, found in (("actor-1", ["one/actor-1", "two/actor-1"]), ("two/actor-1", ["two/actor-1"])):
        detail = analyse_runs(folders, AnalysisOptions(episode=3, actor=actor)).figures()["episode_detail"]
        assert [episode["actor"] for episode in detail] == found


def test_a_process_of_an_earlier_run_is_not_silent_in_a_later_one(two: Two) -> None:
    single, both = two
    for label, figures in zip(("one", "two"), single, strict=True):
        assert both["training"][f"{label}/ground"] == figures["training"]["ground"], "curves are not joined"
        for name, process in figures["processes"].items():
            assert both["processes"][f"{label}/{name}"]["ended"] == process["ended"]
    assert {p["ended"] for p in both["processes"].values()} == {"in order", "alive at the end of the log"}


def test_names_of_runs() -> None:
    paths = ["a/run.mcap", "a/run_0001.mcap", "a/other.mcap", "b/run.mcap", "c/a/run.mcap"]
    runs = by_run([Path(path) for path in paths])
    assert list(runs) == ["a", "a/other", "b", "a (2)"]
    assert [path.name for path in runs["a"]] == ["run.mcap", "run_0001.mcap"]


def test_missing_segments_and_damage_are_reported(tmp_path: Path) -> None:
    writer = Writer()
    for number in range(4):
        writer.episode("actor-0", number)
        writer.write(tmp_path / "run.mcap")
    (tmp_path / "run_0002.mcap").unlink()
    whole = (tmp_path / "run_0003.mcap").read_bytes()
    (tmp_path / "run_0003.mcap").write_bytes(whole[: len(whole) // 2])
    figures = analyse(tmp_path)
    missing, damaged = figures["cuts"]
    assert "run_0002.mcap: this segment is missing" in missing and "cannot be read" in damaged
    assert figures["topics"]["step/ground/actor-0"]["missing"] > 0


@pytest.mark.parametrize("lost", [0, 3])
def test_steps_that_a_learner_had_and_nobody_recorded_are_missing(tmp_path: Path, lost: int) -> None:
    """No count of the actor's is in the log: no recorder ran when it ended."""
    writer = Writer()
    for k in range(5):
        writer.put("step/ground/actor-0", pb.Step(robot="ground", actor="actor-0", step=k))
    writer.put("metrics/ground", pb.LearnerMetrics(robot="ground", steps=5 + lost, limit={"actor-0": 90}))
    cuts = analyse(writer.write(tmp_path / "run.mcap"))["cuts"]
    assert cuts == ["3 of the 8 steps that the learner of ground had are not in the log"] * (lost == 3)


@pytest.mark.parametrize(
    ("saved", "said"),
    [
        ({"log_messages": {"missing": 4}}, True),
        ({"log_messages": {"missing": 2}}, False),
        ({"log_messages": None}, False),
    ],
    ids=["last", "counted in the log", "without a log"],
)
def test_the_last_messages_of_a_run_are_missing_by_its_own_count(tmp_path: Path, saved: Any, said: bool) -> None:
    """Nothing in the log follows them: the last sign of life of their process is lost, too."""
    writer, key = Writer(), "step/ground/actor-0"
    for k in range(2):
        writer.put(key, pb.Step(robot="ground", actor="actor-0", step=2 * k), always=True)
        writer.published[key, 1] += 2
    (tmp_path / "figures.json").write_text(json.dumps(saved))
    figures = analyse(writer.write(tmp_path / "run.mcap"))
    assert figures["topics"][key]["missing"] == 2
    assert figures["cuts"] == [
        "4 messages that the run published are not in the log; only 2 of them leave a gap in it"
    ] * int(said)


def test_steps_that_a_feeder_published_from_other_logs_are_not_missing(tmp_path: Path) -> None:
    writer = Writer()
    published = {"logged/ground/a": 4, "logged/ground/b": 3, "logged/quadrotor/a": 9}
    for count in (0, 1):
        health = pb.Health(
            process="feeder", published={key: n * count for key, n in published.items()}, last=count == 1
        )
        writer.put("health/feeder", health, always=True)
    for robot in ("ground", "quadrotor"):
        writer.put(f"metrics/{robot}", pb.LearnerMetrics(robot=robot, steps=9), always=True)
    cuts = analyse(writer.write(tmp_path / "run.mcap"))["cuts"]
    assert cuts == ["2 of the 9 steps that the learner of ground had are not in the log"]


def test_the_table_of_an_episode_has_the_recorded_values(
    log: Path, figures: dict[str, Any], messages: Messages
) -> None:
    assert len(figures["episode_detail"]) == 3, "of every actor"
    (detail,) = (detail for detail in figures["episode_detail"] if detail["actor"] == "actor-1")
    options = AnalysisOptions(episode=3, actor="actor-1")
    assert [row["actor"] for row in analyse_runs(log, options).figures()["episode_detail"]] == ["actor-1"]
    steps = [m for key, m in once(messages) if key == "step/ground/actor-1" and m.episode == 3]
    exchanges = [m for key, m in once(messages) if key == "exchange/ground/actor-1"]
    asked = {m.request.step: m for m in exchanges if m.request.episode == 3}
    assert [row["step"] for row in detail["rows"]] == [step.step for step in steps]
    for row, step in zip(detail["rows"], steps, strict=True):
        assert (row["reward"], row["clearance"], row["action"]) == (step.reward, step.clearance, list(step.action))
        if step.step in asked and not step.fallback:
            assert row["decide_ms"] == asked[step.step].reply.decision.time_ms
    assert detail["closest"] == min(map(least_clearance, steps)) and detail["start"] == [0.0, 0.0]
    table = printed(show_episode(detail), 200)
    assert "actor-1, episode 3" in table and "x, y [m]" in table
    (drone,) = (detail for detail in figures["episode_detail"] if detail["robot"] == "quadrotor")
    assert "x, y, z [m]" in printed(show_episode(drone), 200)
    assert " ".join(f"{value:.2f}" for value in drone["rows"][0]["state"][:3]) in printed(show_episode(drone), 200)


def test_a_long_episode_is_told_to_its_end(tmp_path: Path) -> None:
    """Ten minutes and more of one robot's driving: its program may never end an episode. One actor starts twice."""
    writer, length = Writer(losses=0.0), MOST_STEPS + 40
    for run, steps in ((1, 5), (2, length)):
        for k in range(steps):
            step = writer._step("actor-0", 7, k, "ground", 1)
            step.reward, step.closest = 1.0, 0.5 - 0.1 * (k == length - 3)
            step.collision = step.terminated = run == 2 and k == length - 1
            writer.put("exchange/ground/actor-0", writer._exchange(step, 2), run)
            writer.put("step/ground/actor-0", step, run)
    writer.write(tmp_path / "run.mcap")
    figures = analyse_runs(tmp_path, AnalysisOptions(episode=7)).figures()
    cut, long = figures["episode_detail"]
    assert cut["outcome"] == "unfinished" and len(cut["rows"]) == 5
    assert (long["outcome"], long["steps"], long["reward"]) == ("collision", length, length)
    assert len(long["rows"]) == length and long["rows"][-1]["end"] == "collision"
    assert long["closest"] == pytest.approx(0.4) and long["closest_at"] == length - 3
    assert all(row["round_trip_ms"] is not None for row in (*cut["rows"], *long["rows"]))
    (_, pictures) = analyse_runs(tmp_path, AnalysisOptions(pictures=True)).by_label()[tmp_path.name]
    drawn = pictures["galleries"]["ground"]["episodes"][-1]
    assert (drawn["outcome"], drawn["steps"], len(drawn["x"])) == ("collision", length, MOST_STEPS)
    assert drawn["interventions"] == figures["interventions"] - cut["interventions"]


def test_the_nearest_misses_are_the_nearest(analysis: LogAnalysis, messages: Messages) -> None:
    pictures = analysis.by_label()["mixed"][1]
    closest: dict[tuple[str, int, int], float] = {}
    for key, step in once(messages):
        if key.startswith("step/ground"):
            place = key.rsplit("/", 1)[1], step.header.run, step.episode
            closest[place] = min(closest.get(place, 1e9), least_clearance(step))
    gallery = pictures["galleries"]["ground"]
    by_order = {episode["order"]: episode for episode in gallery["episodes"]}
    assert [by_order[order]["closest"] for order in gallery["near"]] == sorted(closest.values())[:8]
    near = by_order[gallery["near"][0]]
    assert near["tubes"] and len(near["tubes"][min(near["tubes"])]["boxes"]) == 3
    drone = pictures["galleries"]["quadrotor"]["episodes"][0]
    assert len(drone["goal"]) == 3 and drone["heading"] is None and len(drone["z"]) == len(drone["x"]) > 0
    assert pictures["timeline"]["lines"][0]["text"] == "killed soon"
    assert {life["process"] for life in pictures["timeline"]["lives"]} == {"actor-0", "actor-1"}
    json.dumps(pictures, allow_nan=False)


def test_it_is_shown_whole(figures: dict[str, Any]) -> None:
    text = printed(show(figures, verbose=True))
    words = ("closest approach", "network", "95 %:", "over the run", "half-width", "bound_step 0.003", "primal_inf")
    assert not [word for word in words if word not in text]


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Three times the messages need little more memory, for new bins of sketches. For gigabytes of messages, run
    `python -m benchmarks logs-2gb`."""
    held = []
    for name, rounds in (("short", 26), ("long", 78)):
        writer = Writer(3, losses=0.0)
        for number in range(rounds):
            writer.episode("actor-0", number)
            if number % 26 == 25:
                writer.write(tmp_path / name / "run.mcap")
        tracemalloc.start()
        analysis = analyse_runs(tmp_path / name, AnalysisOptions(pictures=True))
        held.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        _, pictures = analysis.by_label()[name]
        assert len(pictures["galleries"]["ground"]["episodes"]) <= SPREAD + 8 + 8 + 4 + 1
    assert held[1] - held[0] < 0.4 * 2**20


def test_bins_become_wider_instead_of_more() -> None:
    training, timeline = LearningCurve(), ProcessTimeline()
    for k in range(40_000):
        step = pb.Step(actor="a", episode=k // 100, step=k % 100, decision=pb.ADJUSTED)
        step.terminated = step.goal = k % 100 == 99
        training.step(step)
        timeline.step(BEGIN + k * SECOND)
    figures = training.figures()
    assert len(figures["bins"]) <= MOST_BINS and figures["bins"][-1]["until"] == 40_000
    assert {row["adjusted"] for row in figures["bins"]} == {1.0}
    assert sum(row["episodes"] for row in figures["bins"]) == 400
    times = timeline.figures()
    assert len(times["steps"]) <= MOST_TIMES and {rate for _, rate in times["steps"][:-1]} == {1.0}


def test_curves_count_the_interventions_and_collisions_that_the_summary_counts() -> None:
    """A program of your own may drive on after a collision."""
    curve, kinds = LearningCurve(), [pb.ALLOWED, pb.ADJUSTED, pb.FAILSAFE, pb.RECOVERING, pb.RECOVERING]
    for k, kind in enumerate(kinds):
        curve.step(pb.Step(actor="a", step=k, decision=kind, truncated=k == 4, collision=k in (1, 2)))
    figures = curve.figures()
    (row,) = figures["bins"]
    assert interventions_in(row) == pytest.approx(figures["last"]["interventions"]) == 0.8
    assert row["collisions"] == figures["last"]["collisions"] == 1
    before = {name: value for name, value in row.items() if name != "recovering"}
    assert interventions_in(before) == pytest.approx(0.4), "a row that an earlier version wrote"


@pytest.mark.parametrize("name", ["backup.mcap", "zz.mcap"])
def test_a_copy_of_a_log_in_its_folder_counts_once(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    """A backup, and a longer copy with pictures; the run itself has two files. Another run in the folder counts."""
    mixed(tmp_path, episodes=4)
    alone = analyse_runs(tmp_path).figures()
    open_segment(tmp_path / "run.mcap", ABOUT).finish()  # of a recorder that ended before the first message
    alone["log"].append(str(tmp_path / "run_0002.mcap"))
    shutil.copy(tmp_path / "run.mcap", tmp_path / name)
    to_foxglove(Log(find(tmp_path / "run.mcap")), tmp_path / "pictures.mcap")
    figures = analyse_runs(tmp_path).figures()
    assert list(figures["runs"]) == [tmp_path.name]
    assert {**figures, "segments": None, "runs": None} == {**alone, "segments": None, "runs": None}
    assert f"{name} is a copy of" in caplog.text and "run.mcap is a copy" not in caplog.text
    assert sum(1 for _ in read(tmp_path)) == sum(1 for _ in read(tmp_path / "run.mcap"))
    shutil.copy(mixed(tmp_path / "other", seed=1, episodes=2) / "run.mcap", tmp_path / "other.mcap")
    both = analyse_runs(tmp_path).figures()
    assert len(both["runs"]) == 2 and both["steps"] > alone["steps"]


def test_a_cut_episode_is_not_joined_with_the_next_one_whose_first_step_is_lost() -> None:
    curve = LearningCurve()
    for episode, numbers in ((0, range(5)), (1, range(1, 10))):
        for k in numbers:
            kind = pb.ALLOWED if episode else pb.ADJUSTED
            curve.step(pb.Step(actor="a", episode=episode, step=k, decision=kind, terminated=(episode, k) == (1, 9)))
    last = curve.figures()["last"]
    assert (last["episodes"], last["interventions"], last["reward"]) == (1, 0.0, None)


def test_a_change_shows_in_the_windows_the_widening_the_widths_and_the_model_sets() -> None:
    training = LearningCurve()
    for k in range(200):
        changed, anew = k >= 50, k >= 150
        decision = pb.Decision(model="new" if anew else "old", tube_half_width=[0.01, 0.06 if changed else 0.02])
        decision.score = 2.0 if changed and not anew else 0.5
        request = pb.Request(widening=3.0 if changed and not anew else 0.0)
        training.exchange(pb.Exchange(request=request, reply=pb.Reply(decision=decision)))
        training.step(pb.Step(actor="a", step=k))
    figures = training.figures()
    assert figures["models"] == [{"model": "old", "from": 0}, {"model": "new", "from": 150}]
    rows = figures["bins"]
    for name, values in {"beyond": (0, 1, 1, 0), "beyond_widened": (0, 0, 0, 0), "widening": (1, 3, 3, 1)}.items():
        assert [row[name] for row in rows] == pytest.approx(values), name
    assert [row["half_width"] for row in rows] == pytest.approx([0.02, 0.06, 0.06, 0.06])


def test_lives_of_a_process_that_fell_silent_and_was_started_again() -> None:
    timeline = ProcessTimeline()
    for run, seconds in ((1, (0, 1, 2, 9, 10)), (2, (12, 13))):
        for second in seconds:
            health = pb.Health(process="a", last=second == 13)
            health.header.run, health.header.wall_time = run, BEGIN + second * SECOND
            timeline.health(health, health.header.wall_time)
    lives = [(life.start - BEGIN / 1e9, life.end - BEGIN / 1e9, life.goodbye, life.restart) for life in timeline.lives]
    assert lives == [(0.0, 2.0, False, False), (9.0, 10.0, False, False), (12.0, 13.0, True, True)]


@pytest.mark.parametrize("columns", [60, 80, 160])
def test_console_output_is_complete_at_any_width(two: Two, columns: int) -> None:
    single, both = two
    for figures in (single[0], both):
        shown = printed(show(figures), columns, force_terminal=True, color_system=None)
        assert "…" not in shown and max(map(len, shown.splitlines())) <= columns
        assert "flight_" not in shown and "bound_step" not in shown, "noise and model sets are for --verbose"
    assert str(both["goals"]) not in re.findall(r"(?m)^goals +(\d+)", shown), "several runs are not pooled"


def test_steps_after_a_gap_count_once_the_learners_permission_is_known(tmp_path: Path) -> None:
    """A recorder that was killed hears the actor before it hears the learner; what nobody permits never counts."""
    writer = Writer(losses=0.0)

    def add(limit: int, indices: Iterable[int]) -> dict[str, Any]:
        """Add a learner's message and steps; return the figures of the log so far."""
        writer.put("metrics/ground", pb.LearnerMetrics(robot="ground", limit={"actor-0": limit}))
        for index in indices:
            step = pb.Step(robot="ground", actor="actor-0", episode=1, step=index, index=index, state=[0.1] * 5)
            step.decision = pb.ADJUSTED
            writer.put("step/ground/actor-0", step)
        writer.write(tmp_path / "run.mcap")
        figures = RunAnalysis("gap", Log(find(tmp_path)), AnalysisOptions(pictures=True)).figures()
        assert figures["steps"] == sum(row["steps"] for row in figures["training"]["ground"]["bins"])
        return figures

    figures = add(20, (1, 2, 3, *range(4036, 4046)))
    assert (figures["steps"], figures["refused"]) == (3, 10)
    figures = add(4050, (4046, 4046, *range(9_000, 10_100)))
    assert (figures["steps"], figures["refused"]) == (14, 1101)
    figures = add(4060, ())
    assert (figures["steps"], figures["refused"]) == (14, 1101)
