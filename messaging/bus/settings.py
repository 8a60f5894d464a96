"""Where the bus is, and how a session of it is set up."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass

import zenoh

from messaging.bus.errors import Unreachable

SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")  # where in Zenoh's source an error arose


@dataclass(frozen=True)
class BusSettings:
    """Where the bus is. Endpoints are written as Zenoh writes them: `tcp/127.0.0.1:7447`, `unixsock-stream//tmp/bus`.

    A client takes the first of `connect` that answers. `patience` is how long it waits for one at the start;
    once connected it reconnects by itself for ever. A peer that is silent for `lease` counts as gone.
    """

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    prefix: str = "brakeline"
    patience: float = 10.0  # s
    lease: float = 1.5  # s
    stall: float = 1.0  # s, the longest a publisher waits for a receiver that does not drain, before the link is closed


def configuration(settings: BusSettings) -> zenoh.Config:
    """The Zenoh configuration of one session.

    Raises:
        ValueError: neither `connect` nor `listen` is given.
    """
    if not (settings.connect or settings.listen):
        raise ValueError("a bus needs an endpoint: `connect` to a router, or `listen` to be one")
    client = not settings.listen
    values: dict[str, object] = {
        "mode": "client" if client else "router",
        "connect/endpoints": settings.connect,
        "connect/exit_on_failure": client,
        "connect/timeout_ms": int(settings.patience * 1e3) if client else -1,
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
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(settings: BusSettings) -> zenoh.Session:
    """
    Raises:
        Unreachable: no router answered, or an endpoint cannot be listened on.
    """
    try:
        return zenoh.open(configuration(settings))
    except zenoh.ZError as error:
        why = SOURCE.sub("", str(error))
        if settings.listen:
            raise Unreachable(f"cannot listen on {', '.join(settings.listen)}: {why}") from error
        raise Unreachable(
            f"no router at {', '.join(settings.connect)} within {settings.patience:.0f} s; start one there "
            f"(any process with --listen), or check --connect: {why}"
        ) from error
