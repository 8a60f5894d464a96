"""The settings of a bus, and how a process opens a Zenoh session with them."""

from __future__ import annotations

import ipaddress
import re
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

from brakeline.errors import BadKeys, Unreachable
from brakeline.messaging.bus.access_control import access, size_limits
from brakeline.messaging.bus.identity import names_in, tls
from brakeline.messaging.bus.zenoh_sessions import zenoh_config
from brakeline.messaging.topics import FILE

FIRST_PAUSE, LONGEST_PAUSE = 0.1, 1.0  # between two attempts to connect to a router [s]
MOST_UNAUTHENTICATED = 4000  # connections that wait for their authentication at a router
AUTHENTICATION_TIME = 3.0  # for it [s]
MOST_SESSIONS = 10_000  # of a router
ENDPOINT = re.compile(r"[a-z][a-z0-9_]*(-[a-z0-9_]+)?/.+", re.DOTALL)  # PROTOCOL/ADDRESS
SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")  # the place in Zenoh's source in an error message


@dataclass(frozen=True)
class BusSettings:
    """The endpoints of a bus in Zenoh's form, such as `tcp/127.0.0.1:7447` or `unixsock-stream//tmp/bus`.

    With `keys`, all endpoints are `tls/HOST:PORT`, both ends of a link authenticate themselves, and a router enforces
    the table of topics. Without keys, a bus that other machines can reach does not start, unless it is `insecure`.

    >>> BusSettings(connect=("tcp/10.0.0.7:7447",)).warning
    'INSECURE: no keys at tcp/10.0.0.7:7447; whoever reaches it can command the robots'

    Attributes:
        connect: endpoints of routers. A client uses the first one that answers, and reconnects by itself later.
        listen: endpoints at which the process is a router.
        patience: time to wait for a router at the start [s].
        lease: time after which a peer that sends nothing counts as gone [s]. On a busy machine, a process may get no
            processor time for seconds, and a recorder must not lose what others publish meanwhile. Each end sends a
            sign of life in a quarter of this time, so three quarters of it are sure to do no harm.
        query_lease: the same time for a client that asks or answers queries [s]. It is short, so that another service
            soon answers in place of one that hangs.
        stall: time for which a publisher waits for a receiver that reads nothing, before it closes the link [s].
        keys: folder with the keys (messaging/bus/certificate_authority.py).
        metrics: PORT or HOST:PORT at which the process serves its metrics; empty: it serves none.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    prefix: str = "brakeline"
    patience: float = 10.0
    lease: float = 5.0
    query_lease: float = 1.5
    stall: float = 1.0
    keys: Path | None = None
    insecure: bool = False
    metrics: str = ""

    @property
    def warning(self) -> str:
        """A warning if other machines can reach the endpoints without authentication; otherwise empty."""
        open_to_others = [endpoint for endpoint in (*self.listen, *self.connect) if not local(endpoint)]
        if self.keys is not None or not open_to_others:
            return ""
        return f"INSECURE: no keys at {', '.join(open_to_others)}; whoever reaches it can command the robots"

    def check(self) -> None:
        """Check the settings.

        Raises:
            ValueError: there is no endpoint, or one has another form, or needs keys and there are none, or the reverse.
            BadKeys: other machines could connect, and there are no keys.
        """
        for name in ("connect", "listen"):
            if isinstance(value := getattr(self, name), str):
                raise ValueError(f"{name} is a text: give a tuple of endpoints, such as ({value!r},)")
        endpoints = (*self.connect, *self.listen)
        if not endpoints:
            raise ValueError("a bus needs an endpoint: `connect` to a router, or `listen` to be one")
        for endpoint in endpoints:
            if not ENDPOINT.match(endpoint):
                raise ValueError(f"{endpoint!r} is no endpoint: give PROTOCOL/HOST:PORT, such as tcp/127.0.0.1:7447")
            if endpoint.startswith("tls/") and self.keys is None:
                how = "give --keys FOLDER, or set BRAKELINE_KEYS; in Python, give keys=FOLDER"
                raise ValueError(f"{endpoint}: a bus at tls/ needs keys: {how}")
            if self.keys is not None and not endpoint.startswith("tls/"):
                raise ValueError(
                    f"{endpoint}: with keys a bus is at tls/HOST:PORT: correct it, or leave out the keys ({self.keys})"
                )
        open_to_others = [endpoint for endpoint in self.listen if not local(endpoint)]
        if self.keys is None and not self.insecure and open_to_others:
            raise BadKeys(
                f"{', '.join(open_to_others)} is open to other machines: give --keys FOLDER (`brakeline keys` makes "
                "one) and tls/HOST:PORT, or listen on 127.0.0.1; --insecure goes without"
            )


def local(endpoint: str) -> bool:
    """Return whether an endpoint is within this machine."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix") or not address:  # the name of a file, or no endpoint
        return True
    host = address.split("#")[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def configuration(settings: BusSettings, source: str, lease: float | None = None) -> zenoh.Config:
    """Return the Zenoh configuration of a session of the process `source`.

    Args:
        lease: time of silence after which the other end closes the link [s]; None: that of the settings.

    Raises:
        ValueError: see `BusSettings.check`.
        BadKeys: see `BusSettings.check`; or the process has no keys, or none to listen with.
    """
    settings.check()
    client = not settings.listen
    values: dict[str, object] = {
        "mode": "client" if client else "router",
        "connect/endpoints": settings.connect,
        "connect/exit_on_failure": client,
        # With 0 a client tries each endpoint once, and `open_session` repeats; otherwise Zenoh retries only the first.
        "connect/timeout_ms": 0 if client else -1,
        "listen/endpoints": settings.listen,
        "scouting/gossip/enabled": False,
        # Clients that have not authenticated themselves must not take the places of those that will.
        "transport/unicast/accept_pending": MOST_UNAUTHENTICATED,
        "transport/unicast/accept_timeout": int(AUTHENTICATION_TIME * 1e3),
        "transport/unicast/max_sessions": MOST_SESSIONS,
        "transport/link/rx/max_message_size": 2 * FILE,
        "transport/link/tx/lease": int((lease or settings.lease) * 1e3),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(settings.stall * 1e6),
    }
    if settings.keys is not None:
        values["transport/link/tls"] = tls(settings.keys, source, listens=not client)
        if not client:
            values["access_control"] = access(names_in(settings.keys), settings.prefix)
    if not client:
        values["low_pass_filter"] = size_limits(settings.prefix)
    return zenoh_config(values)


def open_session(settings: BusSettings, source: str, lease: float | None = None) -> zenoh.Session:
    """Open a session of the process `source`; lease: see `configuration`.

    Raises:
        Unreachable: no router answered, or the process cannot listen on an endpoint.
        ValueError, BadKeys: see `configuration`.
    """
    until = time.monotonic() + (0.0 if settings.listen else settings.patience)
    pause = FIRST_PAUSE
    while True:
        try:
            return zenoh.open(configuration(settings, source, lease))
        except zenoh.ZError as error:
            left = until - time.monotonic()
            if left <= 0.0:
                raise _unreachable(settings, error) from error
        time.sleep(min(pause, left))
        pause = min(2.0 * pause, LONGEST_PAUSE)


def _unreachable(settings: BusSettings, error: zenoh.ZError) -> Unreachable:
    why = SOURCE.sub("", str(error))
    if settings.listen:
        return Unreachable(f"cannot listen on {', '.join(settings.listen)}: {why}")
    keys = "" if settings.keys is None else ", and that its keys and these are of one authority"
    return Unreachable(
        f"nothing answered at {', '.join(settings.connect)} within {settings.patience:.0f} s: start a service there "
        f"(`brakeline safety ROBOT --listen {settings.connect[0]}`, or any other process with --listen), or check "
        f"--connect{keys} ({why.strip()})"
    )
