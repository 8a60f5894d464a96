"""Several hosts on one machine: network namespaces, each with a stack of its own, a cable to one switch, and a clock.

Cables can be pulled; between two hosts there may be one besides the switch. The machine itself has a cable too, to look
on. It takes Linux, root and iproute2; clocks that differ take gcc.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

CLOCK = Path(__file__).with_name("clock.c")  # what a host whose clock is off loads first
MACHINE = 254  # the machine's own number on the switch


class NoHosts(RuntimeError):
    """Namespaces can't be made here; the message says why."""


def ip(*words: object) -> None:
    """Raises NoHosts with what `ip` says."""
    if shutil.which("ip") is None:
        raise NoHosts("there is no `ip` (Debian: iproute2)")
    done = subprocess.run(["ip", *map(str, words)], check=False, capture_output=True, text=True)
    if done.returncode:
        raise NoHosts(f"ip {' '.join(map(str, words))}: {done.stderr.strip()}")


class Hosts:
    """`count` hosts, numbered from 1, until the end of the block."""

    def __init__(self, count: int, clocks: Mapping[int, float] | None = None) -> None:
        """clocks: hours that a host's clock is ahead, where there is gcc.

        Raises:
            NoHosts: they can't be made here.
        """
        self.count, self._clocks = count, dict(clocks or {})
        self._name = f"bl{os.getpid()}"
        self._net = f"10.213.{os.getpid() % 250}"
        self._started: list[subprocess.Popen[bytes]] = []
        self._folder = tempfile.TemporaryDirectory(prefix=self._name)
        self.clock = self._compiled() if self._clocks else None
        try:
            self._build()
        except NoHosts:
            self.close()
            raise

    def address(self, host: int) -> str:
        return f"{self._net}.{host}"

    def joined(self, host: int) -> str:
        """A host's address on the cable that `join` laid."""
        return f"10.214.{os.getpid() % 250}.{host}"

    def join(self, one: int, other: int) -> None:
        """A cable between two hosts, besides the switch."""
        ip(
            "-n",
            self._ns(one),
            "link",
            "add",
            "direct",
            "type",
            "veth",
            "peer",
            "name",
            "direct",
            "netns",
            self._ns(other),
        )
        for host in (one, other):
            ip("-n", self._ns(host), "address", "add", f"{self.joined(host)}/24", "dev", "direct")
            ip("-n", self._ns(host), "link", "set", "direct", "up")

    def unjoin(self, host: int, joined: bool = False) -> None:
        """Pull the cable between the two hosts, or put it in again."""
        ip("-n", self._ns(host), "link", "set", "direct", "up" if joined else "down")

    def cut(self, host: int) -> None:
        """Pull a host's cable out of the switch."""
        ip("-n", self._ns("switch"), "link", "set", f"port{host}", "down")

    def heal(self, host: int) -> None:
        """Put it in again."""
        ip("-n", self._ns("switch"), "link", "set", f"port{host}", "up")

    def start(self, host: int, words: list[str], output: Path, **environment: str) -> subprocess.Popen[bytes]:
        """A process on a host, with the host's clock; what it says is appended to `output`."""
        if self.clock is not None and host in self._clocks:
            ahead = round(3600 * self._clocks[host])
            environment |= {"LD_PRELOAD": str(self.clock), "BRAKELINE_AHEAD": str(ahead)}
        with output.open("ab") as out:
            popen = subprocess.Popen(
                ["ip", "netns", "exec", self._ns(host), *words],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                env=os.environ | environment,
            )
        self._started.append(popen)
        return popen

    def close(self) -> None:
        """End what runs there, and take everything down."""
        for popen in self._started:
            if popen.poll() is None:
                popen.kill()
            popen.wait()
        for host in (*range(1, self.count + 1), "switch"):  # the cables go with them
            subprocess.run(["ip", "netns", "delete", self._ns(host)], check=False, capture_output=True)
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _compiled(self) -> Path | None:
        """The library that sets a process's clock, if there is a compiler."""
        library, gcc = Path(self._folder.name) / "clock.so", shutil.which("gcc")
        if gcc is None:
            return None
        subprocess.run([gcc, "-shared", "-fPIC", "-O2", "-o", library, CLOCK], check=True)
        return library

    def _build(self) -> None:
        switch = self._ns("switch")
        ip("netns", "add", switch)
        ip("-n", switch, "link", "add", "bridge", "type", "bridge")
        ip("-n", switch, "link", "set", "bridge", "up")
        for host in range(1, self.count + 1):
            ip("netns", "add", self._ns(host))
            ip("-n", self._ns(host), "link", "set", "lo", "up")
            self._plug(host, "eth0", "-n", self._ns(host))
        self._plug(MACHINE, self._name)

    def _plug(self, host: int, interface: str, *there: Any) -> None:
        """A cable from an interface to the switch."""
        switch, port = self._ns("switch"), f"port{host}"
        ip(*there, "link", "add", interface, "type", "veth", "peer", "name", port, "netns", switch)
        ip(*there, "address", "add", f"{self.address(host)}/24", "dev", interface)
        ip(*there, "link", "set", interface, "up")
        ip("-n", switch, "link", "set", port, "master", "bridge")
        ip("-n", switch, "link", "set", port, "up")

    def _ns(self, host: int | str) -> str:
        return f"{self._name}-{host}"
