"""Run a PX4 process whose physics this program simulates: find it, configure it, start it, end it."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from brakeline.errors import LaunchError
from brakeline.messaging.free_ports import free_udp_port
from brakeline.sim.kernels.flight_kernels import AIRFRAME as BODY
from brakeline.sim.kernels.flight_kernels import GRAVITY

log = logging.getLogger("brakeline.px4")

AIRFRAME = "none_iris"  # the airframe of PX4 that expects its simulator at a TCP port
FIRST_PORT = 4560  # of the simulator of instance 0; PX4's scripts add the number of the instance
INSTANCES = range(10, 200)  # PX4's own tools use those from 0 on
# Starts PX4 so that it ends with this process; without a simulator it would wait forever (1: PR_SET_PDEATHSIG,
# 9: SIGKILL)
LAUNCH = "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); os.execv(sys.argv[1], sys.argv[1:])"
TRACES = ("px4-sock-{}", "px4_lock-{}")  # files of an instance in the folder for temporary files
START_TIMEOUT = 30.0  # s until PX4 must have connected
HEARTBEAT_RATE = 50  # Hz of simulated time
ALIAS = re.compile(r"^alias (\w+)='px4-", re.MULTILINE)

ARM, TORQUE = BODY.arm, BODY.rotor_torque

# The parameters of the vehicle in sim/quadrotor.xml, and of a companion computer that sends velocities
PARAMETERS: dict[str, float] = {
    "MAV_SYS_ID": 1,
    "IMU_INTEG_RATE": 200,  # Hz, as the physics
    "CA_ROTOR0_PX": ARM, "CA_ROTOR0_PY": ARM, "CA_ROTOR0_KM": TORQUE,
    "CA_ROTOR1_PX": -ARM, "CA_ROTOR1_PY": -ARM, "CA_ROTOR1_KM": TORQUE,
    "CA_ROTOR2_PX": ARM, "CA_ROTOR2_PY": -ARM, "CA_ROTOR2_KM": -TORQUE,
    "CA_ROTOR3_PX": -ARM, "CA_ROTOR3_PY": ARM, "CA_ROTOR3_KM": -TORQUE,
    "THR_MDL_FAC": 0.0,  # thrust is proportional to the command
    "MPC_THR_HOVER": 0.25 * BODY.mass * GRAVITY / BODY.most_thrust,
    "MPC_XY_VEL_MAX": 7.1, "MPC_Z_VEL_MAX_UP": 5.0, "MPC_Z_VEL_MAX_DN": 5.0,  # m/s, the bounds of the robot's inputs
    "MPC_XY_VEL_P_ACC": 4.0, "MPC_XY_VEL_I_ACC": 1.0, "MPC_Z_VEL_P_ACC": 6.0,  # more agile than PX4's default
    "COM_OF_LOSS_T": 0.5,  # s without a setpoint
    "COM_RC_IN_MODE": 4, "NAV_RCL_ACT": 0, "NAV_DLL_ACT": 0, "COM_RCL_EXCEPT": 4,  # no remote control
    "EKF2_MULTI_IMU": 0, "SENS_IMU_MODE": 1,  # one IMU: one estimator
    "EKF2_HGT_REF": 1,  # height from GPS, which agrees with the map
    "SDLOG_MODE": -1,  # no log
}  # fmt: skip


class Px4Process:
    """A running PX4."""

    def __init__(
        self,
        folder: Path,
        remote: int,
        parameters: dict[str, float] | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Start PX4.

        Args:
            folder: a build for SITL, with `px4` or `bin/px4`, and `etc`.
            remote: UDP port for MAVLink.
            parameters: values besides `PARAMETERS`.
            stop: whether to give up before PX4 has started.

        Raises:
            LaunchError: the folder holds no PX4, PX4 did not start, or `stop` returned True.
        """
        binary, aliases, etc = _find_parts(folder)
        # remote, local: UDP ports of 127.0.0.1 that PX4 sends MAVLink to and from
        self.remote, self.local = remote, free_udp_port()
        self._folder = tempfile.TemporaryDirectory(prefix="px4-")
        root = Path(self._folder.name)
        for name in ("bin", "rootfs"):
            (root / name).mkdir()
        self.log = root / "px4.log"  # the file with the output of PX4
        for name in ("px4", *(f"px4-{word}" for word in ALIAS.findall(aliases.read_text()))):
            (root / "bin" / name).symlink_to(binary)
        (root / "bin" / "px4-alias.sh").symlink_to(aliases)
        # PX4's start script looks for these two in PATH first
        values = PARAMETERS | (parameters or {})
        lines = [f"param set {name} {value:.9g}\n" for name, value in values.items()]
        (root / "bin" / "px4-rc.params").write_text("#!/bin/sh\n" + "".join(lines))
        mavlink = f"mavlink start -x -u {self.local} -r 4000000 -f -m onboard -o {remote}\n"
        # The heartbeat has the mode; once a second is five control periods.
        mavlink += f"mavlink stream -u {self.local} -s HEARTBEAT -r {HEARTBEAT_RATE}\n"
        (root / "bin" / "px4-rc.mavlink").write_text("#!/bin/sh\n" + mavlink)
        instance, self._listener = _free_instance()
        self._traces = [Path(tempfile.gettempdir(), name.format(instance)) for name in TRACES]
        environment = os.environ | {"PX4_SIM_MODEL": AIRFRAME, "PATH": f"{root / 'bin'}:{os.environ['PATH']}"}
        program = [str(root / "bin" / "px4"), "-d", "-i", str(instance), "-w", str(root / "rootfs"), str(etc)]
        with self.log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-c", LAUNCH, *program, "-s", "etc/init.d-posix/rcS"],
                cwd=root / "rootfs",
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,  # so that ^C ends only this program
            )
        try:
            self.connection = self._accept(stop)  # TCP connection on which PX4 waits for sensors
        except BaseException:
            self._end()
            raise
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def last_output(self) -> str:
        """Return the end of PX4's output."""
        return "\n".join(self.log.read_text(errors="replace").strip().splitlines()[-8:])

    def close(self) -> None:
        """End PX4, and delete its temporary files."""
        self.connection.close()
        self._end()

    def _end(self) -> None:
        self._process.kill()  # on SIGTERM it would wait for a clock that stands still
        self._process.wait()
        self._listener.close()
        for trace in self._traces:
            trace.unlink(missing_ok=True)
        self._folder.cleanup()

    def _accept(self, stop: Callable[[], bool]) -> socket.socket:
        """Return the connection of our PX4. Another program of this machine may connect, too: it is hung up on."""
        end = time.monotonic() + START_TIMEOUT
        self._listener.settimeout(0.1)
        while time.monotonic() < end and self.alive and not stop():
            try:
                connection, (_, peer) = self._listener.accept()
            except TimeoutError:
                continue
            port = connection.getsockname()[1]
            if _belongs_to(peer, port, self._process.pid):
                return connection
            log.warning("another program than PX4 connected to PX4's simulator at port %d", port)
            connection.close()
        if stop():
            raise LaunchError("asked to stop before PX4 had started")
        raise LaunchError(f"PX4 did not connect to its simulator; the end of its output:\n{self.last_output()}")


def _find_parts(folder: Path) -> tuple[Path, Path, Path]:
    """Return the program, its script of aliases, and the folder of its scripts."""
    folder = folder.resolve()
    for place in (folder / "bin", folder):
        if (place / "px4").is_file() and (place / "px4-alias.sh").is_file() and (folder / "etc").is_dir():
            return place / "px4", place / "px4-alias.sh", folder / "etc"
    raise LaunchError(f"{folder} holds no PX4 for SITL: it must have px4 and px4-alias.sh (or both in bin/), and etc/")


def _belongs_to(peer: int, own: int, session: int) -> bool:
    """Return whether a process of this session has the port `peer`, connected to our port `own`, by the kernel."""
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    ends = f":{peer:04X}", f":{own:04X}"
    names = {f"socket:[{row[9]}]" for row in rows if (row[1][-5:], row[2][-5:]) == ends}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or it is not ours
            ours = os.getsid(int(process.name)) == session
            if ours and names & {str(file.readlink()) for file in (process / "fd").iterdir()}:
                return True
    return False


def _free_instance() -> tuple[int, socket.socket]:
    """Return an instance that no other PX4 of this machine uses, and the socket for its connection."""
    for instance in INSTANCES:
        with Path(tempfile.gettempdir(), TRACES[1].format(instance)).open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return instance, socket.create_server(("127.0.0.1", FIRST_PORT + instance))
            except OSError:
                continue
    raise LaunchError("no free instance of PX4: too many run on this machine")
