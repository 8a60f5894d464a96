"""The bus: publishers, subscribers, queries and liveliness, over Zenoh.

A process with `listen` endpoints is a router; other processes are clients of one of the `connect` endpoints. With keys,
all processes authenticate themselves, and the router lets each one publish and receive what the table of topics grants.
"""

from brakeline.messaging.bus.bus_settings import BusSettings, configuration
from brakeline.messaging.bus.publisher import Publisher
from brakeline.messaging.bus.session import Bus
from brakeline.messaging.bus.subscription import Listener, Sample, Subscription

__all__ = ["Bus", "BusSettings", "Listener", "Publisher", "Sample", "Subscription", "configuration"]
