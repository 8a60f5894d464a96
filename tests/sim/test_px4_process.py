"""The start of a simulated PX4: a program in its place connects late, and another one connects first."""

import os
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from brakeline.sim.autopilot import px4_process
from brakeline.sim.autopilot.px4_process import FIRST_PORT, Px4Process
from tests.waiting import until

# Connects to its simulator when the file GO lies beside it, as PX4's script does.
STAND_IN = """#!{python}
import pathlib, socket, sys, time
while not pathlib.Path({go!r}).exists():
    time.sleep(0.02)
link = socket.create_connection(("127.0.0.1", {port} + int(sys.argv[sys.argv.index("-i") + 1])))
link.sendall(b"px4")
time.sleep(60)
"""


@pytest.fixture
def build(tmp_path, monkeypatch) -> Path:
    """Return a folder with a program in the place of PX4. Temporary files lie below `tmp_path`."""
    folder, files = tmp_path / "build", tmp_path / "tmp"
    for path in (folder / "bin", folder / "etc", files):
        path.mkdir(parents=True)
    text = STAND_IN.format(python=sys.executable, go=str(tmp_path / "GO"), port=FIRST_PORT)
    (folder / "bin" / "px4").write_text(text)
    (folder / "bin" / "px4").chmod(0o755)
    (folder / "bin" / "px4-alias.sh").write_text("")
    monkeypatch.setenv("TMPDIR", str(files))
    monkeypatch.setattr(px4_process.tempfile, "tempdir", None)
    return folder


def left(build: Path) -> list[str]:
    return [path.name for path in (build.parent / "tmp").iterdir() if path.name.startswith("px4-")]


def test_the_first_program_that_connects_is_not_px4(build, caplog) -> None:
    strangers = []

    def stop() -> bool:  # is asked before each wait for a connection
        if not strangers:
            instance = next(n for n in px4_process.INSTANCES if not port_is_free(FIRST_PORT + n))
            strangers.extend(socket.create_connection(("127.0.0.1", FIRST_PORT + instance)) for _ in range(2))
            strangers[0].setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            strangers[0].close()  # reset, before anybody accepts it
            (build.parent / "GO").touch()
        return False

    px4 = Px4Process(build, 14540, stop=stop)
    try:
        assert px4.connection.recv(3) == b"px4"
        assert strangers[1].recv(1) == b"" and "another program than PX4" in caplog.text
    finally:
        px4.close()
        strangers[1].close()
    assert not left(build)


def port_is_free(port: int) -> bool:
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


ROBOT = Path(__file__).parents[2] / "examples" / "px4" / "quadrotor_px4.toml"


@pytest.mark.parametrize(
    "command, status, words",
    [
        (("autopilot", "--truth", "", "--px4"), 1, "asked to stop before PX4 had started"),
        (("collect", str(ROBOT), "--trajectories", "1", "--out"), 128 + signal.SIGTERM, "You can interrupt it"),
    ],
    ids=["autopilot", "collect"],
)
def test_sigterm_during_the_start_of_px4_ends_it_and_leaves_no_files(build, tmp_path, command, status, words) -> None:
    last = str(build) if command[-1] == "--px4" else str(tmp_path / "x.safetensors")
    program = [sys.executable, "-m", "brakeline.deploy.cli", *command, last]
    environment = os.environ | {"BRAKELINE_PX4": str(build)}
    running = subprocess.Popen(program, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
    until(lambda: [*build.parent.glob("tmp/px4-*/bin")], "the command has begun", 60.0)
    running.send_signal(signal.SIGTERM)
    _, err = running.communicate(timeout=20.0)
    assert running.returncode == status and words in err
    assert not left(build)
