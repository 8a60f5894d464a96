"""Jobs that are skipped, refused, resumed; and workers that outlive nobody. Light, for workers import it too."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from brakeline.deploy.experiments.experiment_jobs import complete, configuration, read, result_path, write
from brakeline.deploy.experiments.task_engine import Engine
from brakeline.errors import ResultError
from tests.waiting import until


@dataclass(frozen=True)
class Details:
    """Settings within settings."""

    depth: int = 1


@dataclass(frozen=True)
class Errand:
    """A job that leaves a mark where it was done."""

    number: int
    setting: int = 0
    details: Details = Details()
    robot: str = "ground"

    @property
    def name(self) -> str:
        return f"errand-{self.number}"

    def run(self, folder: Path, say) -> dict:
        if self.number < 0:
            raise RuntimeError("no such number")
        folder.mkdir(parents=True)
        say("half way")
        return {"study": configuration(self), "square": self.number**2}


def test_what_is_there_is_not_run_again(tmp_path):
    jobs, reports = [Errand(n) for n in (1, 2, 3)], []
    write(tmp_path / "results", jobs[1], {"study": configuration(jobs[1]), "square": -1})
    say = lambda name, text: reports.append((name, text))  # noqa: E731
    results = complete(jobs, tmp_path / "results", tmp_path / "runs", engine=Engine(1), say=say)
    assert [result["square"] for result in results] == [1, -1, 9]
    assert reports == [("errand-1", "half way"), ("errand-3", "half way")]
    assert complete(jobs, tmp_path / "results", tmp_path / "elsewhere", engine=Engine(2)) == results
    assert not (tmp_path / "elsewhere").exists(), "the results alone suffice, on any machine"
    assert read(tmp_path / "results", Errand(4)) is None


def test_a_result_from_before_a_setting_had_its_default(tmp_path):
    study = {"number": 1, "details": {}, "robot": "ground"}
    write(tmp_path, Errand(1), {"study": study})
    assert read(tmp_path, Errand(1)) is not None
    for changed in (Errand(1, setting=2), Errand(1, details=Details(2))):
        with pytest.raises(ResultError, match="another"):
            read(tmp_path, changed)
    write(tmp_path, Errand(1), {"study": study | {"former": 3}})
    with pytest.raises(ResultError, match="another former"):
        read(tmp_path, Errand(1))


@pytest.mark.parametrize(
    "content", [b"", b'{"study": {"num', b"[]", b"null", b'{"study": [1]}', b"{}", b"\xff\xfe0", bytes(9)]
)
def test_a_damaged_result_is_named_with_what_to_do(tmp_path, content):
    """After a power cut, a file may be empty."""
    write(tmp_path, Errand(1), {})
    path = result_path(tmp_path, Errand(1))
    path.write_bytes(content)
    with pytest.raises(ResultError, match="run again with --again") as refused:
        read(tmp_path, Errand(1))
    assert str(path) in str(refused.value)
    complete([Errand(1)], tmp_path, tmp_path / "runs", again=True)
    assert read(tmp_path, Errand(1)) is not None


@dataclass(frozen=True)
class Nap(Errand):
    """A job that says which process does it, and does not end."""

    def run(self, folder: Path, say) -> dict:
        folder.mkdir(parents=True)
        write(folder, Errand(self.number), {"pid": os.getpid()})
        time.sleep(600.0)
        return {}


NAPS = """
import signal
from pathlib import Path
from brakeline.deploy.experiments.experiment_jobs import complete
from brakeline.deploy.experiments.task_engine import Engine
from tests.deploy.experiments.test_experiment_jobs import Nap
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    complete([Nap(1), Nap(2)], Path({0!r}) / "results", Path({0!r}) / "runs", engine=Engine(2))
"""


@pytest.fixture
def napping(tmp_path):
    """A process whose two workers are at work, with all its child processes."""
    (tmp_path / "naps.py").write_text(NAPS.format(str(tmp_path)))
    root = Path(__file__).parents[3]
    popen = subprocess.Popen(
        [sys.executable, tmp_path / "naps.py"],
        env=os.environ | {"PYTHONPATH": str(root)},
        stderr=subprocess.PIPE,
        text=True,
    )
    marks = [tmp_path / "runs" / "ground" / f"errand-{n}" / "ground" / f"errand-{n}.json" for n in (1, 2)]
    until(lambda: all(mark.exists() for mark in marks), "both are at work")
    workers = [json.loads(mark.read_text())["pid"] for mark in marks]
    children = psutil.Process(popen.pid).children(recursive=True)
    assert set(workers) <= {child.pid for child in children}
    with popen:
        yield popen, workers
        popen.kill()
    until(lambda: not any(child.is_running() for child in children), "all have ended", 10.0)


def test_killed_it_leaves_no_worker_behind(napping):
    napping[0].kill()


def test_a_second_study_in_the_same_folder_is_refused_before_it_deletes_or_runs_anything(napping, tmp_path):
    results, runs = tmp_path / "results", tmp_path / "runs"
    write(results, Errand(3), {"study": configuration(Errand(3)), "square": -1})
    for again in (True, False):
        with pytest.raises(ResultError, match=r"another study runs in .*ground.*: wait until it ends"):
            complete([Errand(3), Errand(4)], results, runs, again=again)
    assert read(results, Errand(3)) is not None, "a refused one deletes nothing"
    assert complete([Errand(3)], results, runs), "what is there needs no lock"
    complete([Errand(4)], tmp_path / "other", tmp_path / "other")
    napping[0].kill()
    napping[0].wait()
    complete([Errand(4)], results, runs)


def test_interrupted_alone_it_does_not_wait_for_its_workers(napping):
    """A terminal interrupts the workers too, but `kill -INT` and supervisors only their parent."""
    napping[0].send_signal(signal.SIGINT)
    assert napping[0].wait(20.0) != 0


@pytest.mark.parametrize("worker", [0, 1])
def test_a_worker_that_is_killed_ends_it_and_says_what_to_do(napping, worker):
    os.kill(napping[1][worker], signal.SIGKILL)
    assert "run the command again" in napping[0].communicate(timeout=20.0)[1]


@dataclass(frozen=True)
class Short(Nap):
    """A nap, or for number 0 a result that no file can hold."""

    def run(self, folder: Path, say) -> dict:
        return super().run(folder, say) if self.number else {"set": {1}}


def test_if_a_result_cannot_be_stored_no_job_goes_on(tmp_path):
    started = time.monotonic()
    with pytest.raises(TypeError, match="not JSON serializable"):
        complete([Short(n) for n in range(6)], tmp_path / "results", tmp_path / "runs", engine=Engine(2))
    assert time.monotonic() - started < 60.0, "the naps last ten minutes each"


def test_a_folder_that_cannot_hold_results_is_an_error_before_any_job_runs(tmp_path):
    (tmp_path / "results").write_text("a file")
    for engine in (Engine(1), Engine(2)):
        with pytest.raises(NotADirectoryError):
            complete([Errand(1), Errand(2)], tmp_path / "results", tmp_path / "runs", engine=engine)
    assert not (tmp_path / "runs").exists()


def test_side_by_side_they_give_the_same_and_one_that_fails_loses_nothing_that_was_done(tmp_path):
    jobs = [Errand(n) for n in range(5)]
    results = complete(jobs, tmp_path / "results", tmp_path / "runs", engine=Engine(2))
    assert [result["square"] for result in results] == [0, 1, 4, 9, 16]
    assert len(list((tmp_path / "results" / "ground").iterdir())) == 5
    with pytest.raises(RuntimeError, match="no such number"):
        complete([Errand(6), Errand(-1), Errand(7)], tmp_path / "results", tmp_path / "runs", engine=Engine(2))
    assert read(tmp_path / "results", Errand(6)) is not None


def test_a_result_of_other_settings_is_refused_unless_it_shall_be_run_again(tmp_path):
    complete([Errand(1)], tmp_path / "results", tmp_path / "runs", engine=Engine(1))
    with pytest.raises(ResultError, match="another setting") as refused:
        complete([Errand(2), Errand(1, setting=5)], tmp_path / "results", tmp_path / "other", engine=Engine(1))
    assert "errand-1.json" in str(refused.value)
    assert not (tmp_path / "other").exists(), "nothing is run before everything was looked at"
    complete([Errand(1, setting=5)], tmp_path / "results", tmp_path / "again", engine=Engine(1), again=True)
    assert read(tmp_path / "results", Errand(1, setting=5)) is not None


def test_two_jobs_of_one_name_are_refused_before_any_runs(tmp_path):
    """Else a result would count twice, or the last job would overwrite the result of the others."""
    for jobs in ([Errand(1), Errand(1)], [Errand(1, setting=5), Errand(2), Errand(1)]):
        with pytest.raises(ResultError, match=r"errand-1\.json would hold two results"):
            complete(jobs, tmp_path / "results", tmp_path / "runs")
    assert not list(tmp_path.iterdir())
