"""What the bus and a ROS 2 node share: the configuration, errors and end of Zenoh sessions."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import zenoh

from brakeline.errors import BusError

log = logging.getLogger("brakeline.bus")

SHARED: dict[str, object] = {
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
    "scouting/multicast/enabled": False,
    "scouting/delay": 0,  # ms for which a router waits for others to be found, by default 500: nothing looks for them
    # With shared memory, queries were lost silently when a receiver stalled.
    "transport/shared_memory/enabled": False,
    # With the default of 1 ms, one query in 1000 was lost on two busy cores, and large messages on busy links.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
}


def zenoh_config(values: Mapping[str, object]) -> zenoh.Config:
    """Return a configuration with these values and the shared ones."""
    config = zenoh.Config()
    for key, value in (SHARED | dict(values)).items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def as_bus_error(what: str) -> Iterator[None]:
    """Raise Zenoh's errors as `BusError`."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {error}") from error


def close_sessions(sessions: Sequence[Any], joins: Sequence[Callable[[float], None]], timeout: float) -> None:
    """Close sessions, and wait for the threads of their receivers; return even if the network hangs.

    Args:
        joins: wait for threads, with a timeout.
        timeout: for the sessions, and for each function in `joins` [s].
    """

    def close() -> None:
        for session in sessions:
            session.close()  # also undeclares; a second call does nothing

    worker = threading.Thread(target=close, name="bus close", daemon=True)
    worker.start()
    worker.join(timeout)
    if worker.is_alive():
        log.warning("a Zenoh session did not close within %.1f s; leaving it", timeout)
        return
    for join in joins:
        join(timeout)
