"""Several hosts on one machine: network namespaces, each with its own stack, a cable to one switch, and a clock.

Cables can be pulled; two hosts may have a cable besides the switch. The machine itself has a cable too, to look on.
It takes Linux, root and iproute2; clocks that differ take gcc.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path

CLOCK = Path(__file__).with_name("clock.c")  # the library that a host with a shifted clock loads first
MACHINE = 254  # the machine's own number on the switch


class NoHosts(RuntimeError):
    """Namespaces can't be made here; the message says why."""


def ip(words: str) -> None:
    """Run `ip`. Raises NoHosts with its message."""
    if shutil.which("ip") is None:
        raise NoHosts("there is no `ip` (Debian: iproute2)")
    done = subprocess.run(["ip", *words.split()], check=False, capture_output=True, text=True)
    if done.returncode:
        raise NoHosts(f"ip {words}: {done.stderr.strip()}")


class Hosts(AbstractContextManager["Hosts"]):
    """`count` hosts, numbered from 1, until the end of the block."""

    def __init__(self, count: int, clocks: Mapping[int, float] | None = None) -> None:
        """clocks: hours that a host's clock is ahead, if there is gcc. Raises NoHosts."""
        self.count, self._clocks = count, dict(clocks or {})
        self._name = f"bl{os.getpid()}"
        self._started: list[subprocess.Popen[bytes]] = []
        self._folder = tempfile.TemporaryDirectory(prefix=self._name)
        self.clock = self._compiled() if self._clocks else None
        for host, hours in self._clocks.items():
            self.set_clock(host, hours)
        try:
            self._build()
        except NoHosts:
            self.close()
            raise

    def address(self, host: int) -> str:
        return f"10.213.{os.getpid() % 250}.{host}"

    def joined(self, host: int) -> str:
        """Return a host's address on the cable that `join` laid."""
        return f"10.214.{os.getpid() % 250}.{host}"

    def join(self, one: int, other: int) -> None:
        """Lay a cable between two hosts, besides the switch."""
        ip(f"-n {self._ns(one)} link add direct type veth peer name direct netns {self._ns(other)}")
        for host in (one, other):
            ip(f"-n {self._ns(host)} address add {self.joined(host)}/24 dev direct")
            ip(f"-n {self._ns(host)} link set direct up")

    def unjoin(self, host: int, joined: bool = False) -> None:
        """Pull the cable between the two hosts, or put it in again."""
        ip(f"-n {self._ns(host)} link set direct {'up' if joined else 'down'}")

    def cut(self, host: int) -> None:
        """Pull a host's cable out of the switch."""
        ip(f"-n {self._ns('switch')} link set port{host} down")

    def heal(self, host: int) -> None:
        """Put it in again."""
        ip(f"-n {self._ns('switch')} link set port{host} up")

    def set_clock(self, host: int, hours: float) -> None:
        """Set a host's clock: `hours` ahead. Processes that run already see the jump."""
        with self._clock_file(host).open("r+b" if self._clock_file(host).exists() else "wb") as file:
            file.write(round(3600 * hours).to_bytes(8, "little", signed=True))
        self._clocks[host] = hours

    def _clock_file(self, host: int) -> Path:
        return Path(self._folder.name) / f"clock-{host}"

    def start(self, host: int, words: list[str], output: Path, **environment: str) -> subprocess.Popen[bytes]:
        """Start a process on a host, with the host's clock; append its output to a file."""
        if self.clock is not None and host in self._clocks:
            environment |= {"LD_PRELOAD": str(self.clock), "BRAKELINE_AHEAD": str(self._clock_file(host))}
        command, env = ["ip", "netns", "exec", self._ns(host), *words], os.environ | environment
        with output.open("ab") as out:
            popen = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=env)
        self._started.append(popen)
        return popen

    def close(self) -> None:
        """End the processes, and take everything down."""
        for popen in self._started:
            popen.kill()
            popen.wait()
        for host in (*range(1, self.count + 1), "switch"):  # the cables go with them
            subprocess.run(["ip", "netns", "delete", self._ns(host)], check=False, capture_output=True)
        self._folder.cleanup()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _compiled(self) -> Path | None:
        """Compile the library that sets a process's clock, if there is a compiler."""
        library, gcc = Path(self._folder.name) / "clock.so", shutil.which("gcc")
        if gcc is None:
            return None
        subprocess.run([gcc, "-shared", "-fPIC", "-O2", "-o", library, CLOCK], check=True)
        return library

    def _build(self) -> None:
        switch = self._ns("switch")
        ip(f"netns add {switch}")
        ip(f"-n {switch} link add bridge type bridge")
        ip(f"-n {switch} link set bridge up")
        for host in range(1, self.count + 1):
            ip(f"netns add {self._ns(host)}")
            ip(f"-n {self._ns(host)} link set lo up")
            self._plug(host, "eth0", f"-n {self._ns(host)}")
        self._plug(MACHINE, self._name, "")

    def _plug(self, host: int, interface: str, there: str) -> None:
        """Lay a cable from an interface to the switch."""
        switch, port = self._ns("switch"), f"port{host}"
        ip(f"{there} link add {interface} type veth peer name {port} netns {switch}")
        ip(f"{there} address add {self.address(host)}/24 dev {interface}")
        ip(f"{there} link set {interface} up")
        ip(f"-n {switch} link set {port} master bridge")
        ip(f"-n {switch} link set {port} up")

    def _ns(self, host: int | str) -> str:
        return f"{self._name}-{host}"
