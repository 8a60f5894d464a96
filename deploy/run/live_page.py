"""Serve the live page of a run on this machine in a process of its own, and open it in a browser."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.request import urlopen

from brakeline.deploy.interpreter import PYTHON, end_with_parent
from brakeline.deploy.run.processes import client_settings, launcher_pid

NEXT_LOOK = 0.1  # s between two looks whether the run's router listens, or whether somebody has the page open
STAYS = 600.0  # s after the run's end, at most
ENDS_IN = 3.0  # s


class LivePage:
    """The live page of a run that this process launches. It is served until the block ends.

    Attributes:
        notice: what to tell the user: the address of the page, or that there is none. Empty until it is known.
    """

    def __init__(self, folder: Path, browser: bool) -> None:
        """browser: whether to open the page in a browser, if this machine shows one."""
        self.notice = ""
        self._url = ""
        self._folder, self._browser = folder, browser
        self._ended = threading.Event()
        self._popen: subprocess.Popen[str] | None = None
        self._thread = threading.Thread(target=self._serve, name="live page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._ended.set()
        if self._popen is not None:
            self._popen.terminate()
        self._thread.join()

    def stay(self, say: Callable[[str], object]) -> None:
        """After the run: serve the page and its link to the report as long as somebody has the page open."""
        until = time.monotonic() + STAYS
        with contextlib.suppress(KeyboardInterrupt):
            if self._open_pages():
                say(f"The live page and its report stay at {self._url} until you close the page or press ^C.")
            while time.monotonic() < until and self._open_pages():
                time.sleep(NEXT_LOOK)

    def _open_pages(self) -> int:
        """Return how many browsers have the page open; 0 if there is no page."""
        try:
            with urlopen(f"{self._url}view.json", timeout=ENDS_IN) as answer:
                return int(json.loads(answer.read())["pages"])
        except (OSError, ValueError, KeyError):
            return 0

    def _serve(self) -> None:
        """Start the page once the run's router listens, and end it with the block."""
        while not self._listens():
            if self._ended.wait(NEXT_LOOK):
                return
        bus = client_settings(self._folder)
        keys = [] if bus.keys is None else ["--keys", str(bus.keys)]
        words = ["watch", "--connect", *bus.connect, *keys, "--port", "0", "--foxglove-port", "-1", "--json"]
        words += ["--report", str(self._folder)]
        command = [*PYTHON, "-m", "brakeline.deploy.run.live_page", str(os.getpid()), *words]
        logs = self._folder / "logs"
        logs.mkdir(exist_ok=True)
        with (logs / "watch.log").open("ab") as errors:
            self._popen = popen = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,
            )
        assert popen.stdout is not None
        with popen.stdout:
            if not (line := popen.stdout.readline()):
                self.notice = f"no live page: see {logs / 'watch.log'}"
                return
            self._url = json.loads(line)["page"]
            self.notice = f"live page: {self._url}"
            # Without a display, Python would open a browser for text in the terminal.
            display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            if self._browser and (display or sys.platform in ("darwin", "win32")):
                webbrowser.open(self._url)
            self._ended.wait()
        popen.terminate()
        try:
            popen.wait(ENDS_IN)
        except subprocess.TimeoutExpired:
            popen.kill()

    def _listens(self) -> bool:
        """Return whether the folder has the endpoint of this process, not of an earlier one."""
        try:
            return launcher_pid(self._folder) == os.getpid()
        except (OSError, ValueError, KeyError):
            return False


def main(parent: str, *words: str) -> int:
    """Run a command that ends with the process `parent`. Returns the exit status."""
    from brakeline.deploy import cli

    return cli.main(list(words)) if end_with_parent(int(parent)) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
