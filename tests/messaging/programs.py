"""What runs in other processes, and who asks them."""

import subprocess
from collections.abc import Callable

from brakeline.errors import BusError
from brakeline.messaging.bus import Bus
from brakeline.messaging.topics import DECIDE

Join = Callable[..., Bus]
Spawn = Callable[[str], "subprocess.Popen[str]"]

SERVICE = """
import os, sys, time
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.topics import DECIDE
bus = Bus(BusSettings({place}=("{endpoint}",)), "safety-{name}")
bus.serve(DECIDE, lambda payload, asker: b"{name}:" + payload)
print("ready", flush=True)
time.sleep(60)
"""

ROUTER = """
import sys, time
from brakeline.messaging.bus import Bus, BusSettings
bus = Bus(BusSettings(listen=("{endpoint}",)), "router")
print("ready", flush=True)
time.sleep(60)
"""

LISTENER = """
import time
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.topics import LOG
heard = []
bus = Bus(BusSettings(connect=("{endpoint}",)), "recorder")
bus.subscribe(LOG, lambda sample: heard.append(sample.message().header.sequence))
print("ready", flush=True)
until = time.monotonic() + 20.0
while len(heard) < {lines} and time.monotonic() < until:
    time.sleep(0.05)
print("complete" if heard == list(range(1, {lines} + 1)) else heard, flush=True)
"""


def answers(bus: Bus, payload: bytes = b"?", timeout: float = 0.5) -> bytes | None:
    try:
        return bus.ask(DECIDE, payload, timeout=timeout, robot="ground")
    except BusError:
        return None
