"""THE table of what crosses the bus: key, message, delivery, rate, who may publish, who may listen, is it recorded?

`{robot}` and `{source}` in a key are filled in by the publisher and are wildcards for a subscriber. Who asks a query
publishes it, and who listens answers; the answer is a message too. Liveness follows from `rate`: three periods without
a message is stale. Where processes have keys, their routers let nothing pass that is not in this table
(messaging/bus/access_control.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from google.protobuf.message import Message

from brakeline.messaging import brakeline_pb2 as pb

# What a process is to the others. A name begins with its role: "actor-7", "learner-ground", "safety".
ROLES = (
    *("safety", "learner", "actor", "recorder", "certify", "feeder", "launcher", "router"),
    "viewer",  # looks on: watch, status
    "client",  # a program that asks the safety service, and does nothing else
)
RECORDERS = ("recorder", "launcher", "viewer")  # they may hear all that is recorded


class Delivery(Enum):
    """What happens when a receiver does not keep up."""

    DROP = "drop"  # the newest wins: telemetry
    BLOCK = "block"  # nothing is lost while both ends live: steps, under explicit flow control
    QUERY = "query"  # a question with a deadline


@dataclass(frozen=True)
class Topic:
    name: str
    key: str  # under the run's prefix
    message: type[Message]
    delivery: Delivery
    rate: float | None  # Hz, the least to be expected while the publisher lives; None: on occasion
    publishers: tuple[str, ...]  # roles
    subscribers: tuple[str, ...]  # roles, besides `RECORDERS` if it is recorded
    recorded: bool
    answer: type[Message] | None = None  # of a query
    largest: int = 2**20  # bytes of a message: what is larger is passed over
    own: bool = True  # `{source}` is the publisher's own name, or begins with it and a dot; else it may be any

    @property
    def stale_after(self) -> float | None:
        """Seconds without a message after which the publisher counts as gone."""
        return None if self.rate is None else 3.0 / self.rate

    @property
    def listeners(self) -> tuple[str, ...]:
        """Roles that may hear it."""
        return tuple(dict.fromkeys((*self.subscribers, *(RECORDERS if self.recorded else ()))))

    def at(self, **names: str) -> str:
        """The key with its names filled in; a wildcard where none is given."""
        fields = {"robot": "*", "source": "*"} | names
        return self.key.format(**fields)


FILE = 2**26  # bytes: a message that carries one
BLOCK, DROP, QUERY = Delivery.BLOCK, Delivery.DROP, Delivery.QUERY
# fmt: off
DECIDE = Topic("decide", "safety/{robot}/decide", pb.RequestBatch, QUERY, None, ("actor", "client"), ("safety",), False,
               pb.ReplyBatch)
JOIN = Topic("join", "learner/{robot}/join", pb.Join, QUERY, None, ("actor", "feeder"), ("learner",), False,
             pb.JoinReply)
MODEL = Topic("model", "model/{robot}/{source}", pb.Model, BLOCK, None, ("certify",), ("safety",), True, largest=FILE)
STEP = Topic("step", "step/{robot}/{source}", pb.Step, BLOCK, None, ("actor",), ("learner",), True)
LOGGED = Topic("logged", "logged/{robot}/{source}", pb.Step, BLOCK, None, ("feeder",), ("learner",), False, own=False)
EPISODE = Topic("episode", "episode/{robot}/{source}", pb.Episode, BLOCK, None, ("actor",), (), True)
EXCHANGE = Topic("exchange", "exchange/{robot}/{source}", pb.Exchange, BLOCK, None, ("actor",), (), True)
FRAMES = Topic("frames", "frames/{robot}/{source}", pb.MavlinkFrames, BLOCK, None, ("actor",), (), True)
WEIGHTS = Topic("weights", "weights/{robot}", pb.Weights, DROP, None, ("learner",), ("actor", "feeder"), False,
                largest=FILE)
FLOW = Topic("flow", "flow/{robot}", pb.Flow, BLOCK, 1.0, ("learner",), ("actor", "feeder"), False)
LEARNER = Topic("learner", "metrics/{robot}", pb.LearnerMetrics, BLOCK, 1.0, ("learner",), (), True)
HEALTH = Topic("health", "health/{source}", pb.Health, BLOCK, 1.0, ROLES, (), True)
LOG = Topic("log", "log/{source}", pb.LogLine, BLOCK, None, ROLES, (), True)
# fmt: on

TOPICS: tuple[Topic, ...] = (
    *(DECIDE, JOIN, MODEL, STEP, LOGGED, EPISODE, EXCHANGE, FRAMES),
    *(WEIGHTS, FLOW, LEARNER, HEALTH, LOG),
)
RECORDED: tuple[Topic, ...] = tuple(topic for topic in TOPICS if topic.recorded)
