"""THE table of what crosses the bus: key, message, delivery, rate, who publishes, who listens, is it recorded?

`{robot}` and `{source}` in a key are filled in by the publisher and are wildcards for a subscriber. A query's
answer is a message too. Liveness follows from `rate`: three periods without a message is stale.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from google.protobuf.message import Message

from messaging import brakeline_pb2 as pb


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
    publisher: str
    subscribers: tuple[str, ...]
    recorded: bool
    answer: type[Message] | None = None  # of a query
    largest: int = 2**20  # bytes of a message: what is larger is passed over

    @property
    def stale_after(self) -> float | None:
        """Seconds without a message after which the publisher counts as gone."""
        return None if self.rate is None else 3.0 / self.rate

    def at(self, **names: str) -> str:
        """The key with its names filled in; a wildcard where none is given."""
        fields = {"robot": "*", "source": "*"} | names
        return self.key.format(**fields)


FILE = 2**26  # bytes: a message that carries one

DECIDE = Topic(
    "decide", "safety/{robot}/decide", pb.RequestBatch, Delivery.QUERY, None, "actor", ("safety",), False, pb.ReplyBatch
)
JOIN = Topic("join", "learner/{robot}/join", pb.Join, Delivery.QUERY, None, "actor", ("learner",), False, pb.JoinReply)
MODEL = Topic(
    "model", "model/{robot}/{source}", pb.Model, Delivery.BLOCK, None, "certify", ("safety",), True, largest=FILE
)
STEP = Topic("step", "step/{robot}/{source}", pb.Step, Delivery.BLOCK, None, "actor", ("learner", "launcher"), True)
LOGGED = Topic("logged", "logged/{robot}/{source}", pb.Step, Delivery.BLOCK, None, "feeder", ("learner",), False)
EPISODE = Topic("episode", "episode/{robot}/{source}", pb.Episode, Delivery.BLOCK, None, "actor", ("launcher",), True)
EXCHANGE = Topic("exchange", "exchange/{robot}/{source}", pb.Exchange, Delivery.BLOCK, None, "actor", (), True)
FRAMES = Topic("frames", "frames/{robot}/{source}", pb.MavlinkFrames, Delivery.BLOCK, None, "actor", (), True)
WEIGHTS = Topic(
    "weights", "weights/{robot}", pb.Weights, Delivery.DROP, None, "learner", ("actor",), False, largest=FILE
)
FLOW = Topic("flow", "flow/{robot}", pb.Flow, Delivery.BLOCK, 1.0, "learner", ("actor",), False)
LEARNER = Topic(
    "learner", "metrics/{robot}", pb.LearnerMetrics, Delivery.BLOCK, 1.0, "learner", ("launcher", "status"), True
)
HEALTH = Topic("health", "health/{source}", pb.Health, Delivery.BLOCK, 1.0, "all", ("launcher", "status"), True)
LOG = Topic("log", "log/{source}", pb.LogLine, Delivery.BLOCK, None, "all", ("launcher",), True)

TOPICS: tuple[Topic, ...] = (
    *(DECIDE, JOIN, MODEL, STEP, LOGGED, EPISODE, EXCHANGE, FRAMES),
    *(WEIGHTS, FLOW, LEARNER, HEALTH, LOG),
)
RECORDED: tuple[Topic, ...] = tuple(topic for topic in TOPICS if topic.recorded)
