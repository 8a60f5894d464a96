"""Where the bus is, and how a session of it is set up."""

from __future__ import annotations

import ipaddress
import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

from brakeline.errors import Insecure, Unreachable
from brakeline.messaging.bus.access_control import access
from brakeline.messaging.bus.identity import names_in, tls

FIRST_PAUSE, LONGEST_PAUSE = 0.1, 1.0  # s between two attempts to find a router
SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")  # where in Zenoh's source an error arose


@dataclass(frozen=True)
class BusSettings:
    """Where the bus is. Endpoints are written as Zenoh writes them: `tcp/127.0.0.1:7447`, `unixsock-stream//tmp/bus`.

    A client takes the first of `connect` that answers. `patience` is how long it waits for one at the start;
    once connected it reconnects by itself for ever. A peer that is silent for `lease` counts as gone.

    With `keys`, a folder (messaging/bus/certificate_authority.py), all endpoints are `tls/HOST:PORT`, both ends show
    who they are,
    and a router lets through what the table of topics says. Without, a bus that others than this machine reach does
    not start, unless it is `insecure` on purpose.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    prefix: str = "brakeline"
    patience: float = 10.0  # s
    lease: float = 1.5  # s
    stall: float = 1.0  # s, the longest a publisher waits for a receiver that does not drain, before the link is closed
    keys: Path | None = None
    insecure: bool = False
    metrics: str = ""  # PORT or HOST:PORT at which a process serves its metrics; empty: nowhere

    @property
    def warning(self) -> str:
        """What is to be said aloud: nobody on these endpoints shows who it is, and others reach them; else empty."""
        open_to_others = [endpoint for endpoint in (*self.listen, *self.connect) if not local(endpoint)]
        if self.keys is not None or not open_to_others:
            return ""
        return f"INSECURE: no keys at {', '.join(open_to_others)}; whoever reaches it can command the robots"

    def check(self) -> None:
        """Raises:
        ValueError: neither `connect` nor `listen` is given, or the endpoints do not go with the keys.
        Insecure: others than this machine could connect, and there are no keys.
        """
        endpoints = (*self.connect, *self.listen)
        if not endpoints:
            raise ValueError("a bus needs an endpoint: `connect` to a router, or `listen` to be one")
        for endpoint in endpoints:
            if endpoint.startswith("tls/") != (self.keys is not None):
                raise ValueError(f"{endpoint}: with keys a bus is at tls/HOST:PORT, and without it is not")
        open_to_others = [endpoint for endpoint in self.listen if not local(endpoint)]
        if self.keys is None and not self.insecure and open_to_others:
            raise Insecure(
                f"{', '.join(open_to_others)} is open to other machines: give --keys FOLDER (`brakeline keys` makes "
                "one) and tls/HOST:PORT, or listen on 127.0.0.1; --insecure goes without"
            )


def local(endpoint: str) -> bool:
    """Is it within this machine?"""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix") or not address:  # a file's name, or no endpoint at all
        return True
    host = address.split("#")[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def configuration(settings: BusSettings, source: str) -> zenoh.Config:
    """The Zenoh configuration of one session of the process `source`.

    Raises:
        ValueError, Insecure: as `BusSettings.check` says.
        BadKeys: there are no keys of this process, or none that it can listen with.
    """
    settings.check()
    client = not settings.listen
    values: dict[str, object] = {
        "mode": "client" if client else "router",
        "connect/endpoints": settings.connect,
        "connect/exit_on_failure": client,
        # Of a client 0: each endpoint once, and `open_session` does it again; else it goes on with the first alone.
        "connect/timeout_ms": 0 if client else -1,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "listen/endpoints": settings.listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # With it, queries were lost silently when a receiver stalled.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": int(settings.lease * 1e3),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(settings.stall * 1e6),
        # With the default of 1 ms, one query in 1000 was lost on two busy cores, and large messages on busy links.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    }
    if settings.keys is not None:
        values["transport/link/tls"] = tls(settings.keys, source, listens=not client)
        if not client:
            values["access_control"] = access(names_in(settings.keys), settings.prefix)
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(settings: BusSettings, source: str) -> zenoh.Session:
    """Raises:
    Unreachable: no router answered, or an endpoint cannot be listened on.
    ValueError, Insecure, BadKeys: as `configuration` says.
    """
    until = time.monotonic() + (0.0 if settings.listen else settings.patience)
    pause = FIRST_PAUSE
    while True:
        try:
            return zenoh.open(configuration(settings, source))
        except zenoh.ZError as error:
            left = until - time.monotonic()
            if left <= 0.0:
                raise _unreachable(settings, error) from error
        time.sleep(min(pause, left))
        pause = min(2.0 * pause, LONGEST_PAUSE)


def _unreachable(settings: BusSettings, error: zenoh.ZError) -> Unreachable:
    """With what to do."""
    why = SOURCE.sub("", str(error))
    if settings.listen:
        return Unreachable(f"cannot listen on {', '.join(settings.listen)}: {why}")
    keys = "" if settings.keys is None else ", and that its keys and these are of one authority"
    return Unreachable(
        f"no router at {', '.join(settings.connect)} within {settings.patience:.0f} s; start one there "
        f"(any process with --listen), or check --connect{keys}: {why}"
    )
