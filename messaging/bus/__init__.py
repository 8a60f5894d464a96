"""The bus: publishers, subscribers, questions and answers, and who is alive, over Zenoh.

A process that is given `listen` is a router; the others are clients of one of the `connect` endpoints. With keys all
show who they are, and the router lets each say and hear what the table of topics grants it.
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
