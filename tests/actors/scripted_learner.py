"""A scripted learner on a real bus."""

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from brakeline.messaging.policy_weights import MLP
from brakeline.messaging.topics import FLOW, JOIN, WEIGHTS
from tests.robots import GROUND


class ScriptedLearner:
    """The bus side of a learner: it accepts every actor of the right layout, and publishes permissions and weights."""

    def __init__(self, bus: Bus) -> None:
        self.flow = pb.Flow(robot="ground", incarnation=1)
        self.version, self.layout = 1, GROUND.learning_layout()
        self.joins: list[pb.Join] = []
        self._flow, self._weights = bus.publisher(FLOW, robot="ground"), bus.publisher(WEIGHTS, robot="ground")
        bus.serve(JOIN, self._join, robot="ground")

    def _join(self, payload: bytes, asker: str) -> bytes:
        join = pb.Join.FromString(payload)
        self.joins.append(join)
        if join.layout != self.layout:
            error = pb.Error(type="Refused", field="layout", message="another layout")
            return pb.JoinReply(error=error).SerializeToString()
        return pb.JoinReply(weights=self.weights(), flow=self.flow, episode=join.episode + 3).SerializeToString()

    def weights(self) -> pb.Weights:
        file = MLP(GROUND, MLP.untrained(GROUND, 0, (8,)).layers, self.version).encode()
        return pb.Weights(robot="ground", version=self.version, file=file)

    def publish_flow(self, limit: int, **fields: object) -> None:
        self.flow.limit["actor-0"] = limit
        for name, value in fields.items():
            setattr(self.flow, name, value)
        self._flow.put(self.flow)

    def publish_weights(self, version: int) -> None:
        self.version = version
        self._weights.put(self.weights())
