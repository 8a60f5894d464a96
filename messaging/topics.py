"""THE table of topics: key, message, delivery, rate, roles that publish and subscribe, and whether it is recorded.

A publisher fills in `{robot}` and `{source}` in a key; for a subscriber they are wildcards. `{source}` is the name of
the publisher, or begins with it and a dot. The publisher of a query asks it, and a subscriber answers it with another
message. With keys, the routers of a bus let nothing pass that is not in this table (messaging/bus/access_control.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb

# The name of a process begins with its role: "actor-7", "learner-ground", "safety".
ROLES = (
    *("safety", "learner", "actor", "recorder", "certify", "feeder", "launcher", "router"),
    "viewer",  # shows a run: watch, status
    "client",  # a program that only asks the safety service
)
SIMULATORS = (
    "actor",
    "learner",
)  # publish steps of robots; a learner those that it simulates (`train --backend batch`)
RECORDERS = ("recorder", "launcher", "viewer")  # may subscribe to all recorded topics


class Delivery(Enum):
    """What happens if a receiver is too slow."""

    DROP = "drop"  # it misses the oldest messages: telemetry
    BLOCK = "block"  # the publisher waits, and no message is lost: steps, under explicit flow control
    QUERY = "query"  # a query with a deadline


@dataclass(frozen=True)
class Topic:
    """A row of the table."""

    name: str
    key: str  # without the prefix of the bus
    message: type[Message]
    delivery: Delivery
    rate: float | None  # least rate while the publisher lives [Hz]; None: irregular
    publishers: tuple[str, ...]  # roles
    subscribers: tuple[str, ...]  # roles, in addition to `RECORDERS` for a recorded topic
    recorded: bool
    largest: int = 2**20  # bytes; larger messages are rejected
    own: bool = True  # False: `{source}` is an actor of a log, whose steps a feeder publishes

    @property
    def stale_after(self) -> float | None:
        """Time without a message after which the publisher counts as gone: three periods [s]."""
        return None if self.rate is None else 3.0 / self.rate

    @property
    def listeners(self) -> tuple[str, ...]:
        """Roles that may subscribe."""
        return tuple(dict.fromkeys((*self.subscribers, *(RECORDERS if self.recorded else ()))))

    def at(self, **names: str) -> str:
        """Return the key with its names filled in; a missing name becomes a wildcard."""
        fields = {"robot": "*", "source": "*"} | names
        return self.key.format(**fields)


FILE = 2**26  # largest message with a file [bytes]
AHEAD = 1000  # steps beyond its limit in FLOW that an actor may publish: an earlier learner may have permitted them
BLOCK, DROP, QUERY = Delivery.BLOCK, Delivery.DROP, Delivery.QUERY
# fmt: off
DECIDE = Topic("decide", "safety/{robot}/decide/{source}", pb.RequestBatch, QUERY, None, ("actor", "client"),
               ("safety",), False)
JOIN = Topic("join", "learner/{robot}/join/{source}", pb.Join, QUERY, None, ("actor", "feeder"), ("learner",), False)
MODEL = Topic("model", "model/{robot}/{source}", pb.Model, BLOCK, None, ("certify",), ("safety",), True, largest=FILE)
STEP = Topic("step", "step/{robot}/{source}", pb.Step, BLOCK, None, SIMULATORS, ("learner", "certify"), True)
LOGGED = Topic("logged", "logged/{robot}/{source}", pb.Step, BLOCK, None, ("feeder",), ("learner",), False, own=False)
EPISODE = Topic("episode", "episode/{robot}/{source}", pb.Episode, BLOCK, None, SIMULATORS, (), True)
EXCHANGE = Topic("exchange", "exchange/{robot}/{source}", pb.Exchange, BLOCK, None, ("actor",), ("certify",), True)
FRAMES = Topic("frames", "frames/{robot}/{source}", pb.MavlinkFrames, BLOCK, None, ("actor",), (), True)
BUNDLE = Topic("bundle", "bundle/{robot}/{source}", pb.Bundle, BLOCK, None, ("actor",),
               ("learner", "certify", *RECORDERS), False, largest=2**21)
WEIGHTS = Topic("weights", "weights/{robot}", pb.Weights, DROP, None, ("learner",), ("actor", "feeder"), False,
                largest=FILE)
FLOW = Topic("flow", "flow/{robot}", pb.Flow, BLOCK, 1.0, ("learner",), ("actor", "feeder"), False)
LEARNER = Topic("learner", "metrics/{robot}", pb.LearnerMetrics, BLOCK, 1.0, ("learner",), (), True)
HEALTH = Topic("health", "health/{source}", pb.Health, BLOCK, 1.0, ROLES, (), True)
LOG = Topic("log", "log/{source}", pb.LogLine, BLOCK, None, ROLES, (), True)
# fmt: on

TOPICS: tuple[Topic, ...] = (
    *(DECIDE, JOIN, MODEL, STEP, LOGGED, EPISODE, EXCHANGE, FRAMES, BUNDLE),
    *(WEIGHTS, FLOW, LEARNER, HEALTH, LOG),
)
BUNDLED: tuple[Topic, ...] = (STEP, EPISODE, EXCHANGE, FRAMES)  # an actor publishes them under the name of each robot
RECORDED: tuple[Topic, ...] = tuple(topic for topic in TOPICS if topic.recorded)

_BY_ROOT = {topic.key.partition("/")[0]: topic for topic in TOPICS}


def topic_of(key: str) -> Topic | None:
    """Return the topic of a key without the prefix of the bus; None if there is none."""
    return _BY_ROOT.get(key.partition("/")[0])
