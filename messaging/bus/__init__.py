"""The bus: publishers, subscribers, queries and liveliness, over Zenoh.

A process with `listen` endpoints is a router; other processes are clients of one of the `connect` endpoints. With keys,
all processes authenticate themselves, and the router lets each one publish and receive what the table of topics grants.
"""

from brakeline.errors import BadKeys, BusError, Busy, Expired, Insecure, Late, Malformed, NoReply, Refused, Unreachable
from brakeline.messaging.bus.bus_settings import BusSettings, configuration
from brakeline.messaging.bus.publisher import Publisher
from brakeline.messaging.bus.session import Bus
from brakeline.messaging.bus.subscription import Listener, Sample, Subscription

__all__ = [
    "BadKeys",
    "Bus",
    "BusError",
    "BusSettings",
    "Busy",
    "Expired",
    "Insecure",
    "Late",
    "Listener",
    "Malformed",
    "NoReply",
    "Publisher",
    "Refused",
    "Sample",
    "Subscription",
    "Unreachable",
    "configuration",
]
