"""A service's word that it verified a plan, which an actor hands back with its next question and nobody else can make.

The service keeps nothing about a robot, so it has to be told what it decided. A decision on a plan u_0 .. u_{N-1} comes
with a voucher for each of the next periods, until the plan is at its end: the k-th is a MAC (HMAC-SHA-256, 16 bytes) of
what the request will say k periods later if nothing better came in between,

    robot, actor, model | u_{k-1} (the input in force), u_k .. u_{N-1}, stop .. stop (the tail) | prediction, if k = 1,

so that a request needs one of them and nothing is put together again. The replicas of a service share the key.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import struct
from collections.abc import Sequence
from pathlib import Path

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.atomic_files import write_secret
from brakeline.messaging.robot import FEEDBACK, HOLD, Robot
from brakeline.safety.filter.backup_plan import UNVERIFIED

log = logging.getLogger("brakeline.safety")

SIZE = 16  # bytes of a voucher
KEY = "vouchers.key"  # in the folder of keys
LEAST = 32  # bytes of a key


class BadKey(ValueError):
    """There is a key, but it cannot be one."""


def write_key(folder: Path) -> None:
    """A new key, if there is none in the folder yet."""
    if not (folder / KEY).exists():
        write_secret(folder / KEY, secrets.token_bytes(LEAST))


class PlanAuthenticator:
    """Makes vouchers, and knows its own."""

    def __init__(self, key: bytes) -> None:
        if len(key) < LEAST:
            raise BadKey(f"a key of {len(key)} bytes; vouchers take {LEAST}")
        self._key = key

    @classmethod
    def of(cls, folder: Path | None) -> PlanAuthenticator:
        """With the key in a folder of keys; without one, with a key that nobody else has.

        Raises:
            BadKey: the key is too short; OSError: it can't be read.
        """
        if folder is not None and (folder / KEY).exists():
            return cls((folder / KEY).read_bytes())
        log.info("no %s: plans that another replica verified will count as unverified here", KEY)
        return cls(secrets.token_bytes(LEAST))

    def plan_tokens(self, request: pb.Request, decision: pb.Decision, robot: Robot) -> list[bytes]:
        """For a decision on a request: the first for the next period, the last for all from there on, when the plan's
        tail no longer changes."""
        m, n = robot.action_dim, robot.horizon
        plan = list(decision.plan)
        last = [0.0 if robot.stop[j] != HOLD else plan[j - m] for j in range(m)]
        at_end = n
        while at_end > 0 and plan[(at_end - 1) * m : at_end * m] == last:
            at_end -= 1
        inputs = plan + last * (n + 1)
        tails, held = _bytes(inputs), _bytes(_planned(inputs, robot))
        said, row = _words(robot.name, request.actor, decision.model), 8 * m
        predicted = _prediction(decision)
        return [
            self._mac(
                said + held[(k - 1) * row : k * row] + tails[k * row : (k + n) * row] + (predicted if k == 1 else b"")
            )
            for k in range(1, max(2, 1 + at_end) + 1)
        ]

    def is_authentic(self, request: pb.Request, robot: Robot) -> bool:
        """Is it true what a request says of its plan: that a model verified it? It may also say nothing of the kind."""
        if request.model in ("", UNVERIFIED):
            return True
        if len(request.input_in_force) != robot.action_dim:
            return False
        return hmac.compare_digest(self.plan_token(request, robot), request.plan_token)

    def plan_token(self, request: pb.Request, robot: Robot) -> bytes:
        """The one that a request needs."""
        held = _bytes(_planned(request.input_in_force, robot))
        said = _words(robot.name, request.actor, request.model) + held + _bytes(request.plan)
        if request.predicted_center or request.predicted_half_width:
            said += _prediction(request)
        return self._mac(said)

    def _mac(self, message: bytes) -> bytes:
        return hmac.digest(self._key, message, "sha256")[:SIZE]


def _words(robot: str, actor: str, model: str) -> bytes:
    return repr((robot, actor, model)).encode()


def _planned(inputs: Sequence[float], robot: Robot) -> Sequence[float]:
    """Rows of inputs, those at zero that feedback makes of the state: the others are what was planned when in force."""
    if FEEDBACK not in robot.stop:
        return inputs
    m = robot.action_dim
    return [0.0 if robot.stop[i % m] == FEEDBACK else value for i, value in enumerate(inputs)]


def _prediction(message: pb.Request | pb.Decision) -> bytes:
    return _bytes([*message.predicted_center, *message.predicted_half_width, message.predicted_heading])


def _bytes(numbers: Sequence[float]) -> bytes:
    """Doubles, little-endian; zero has one sign."""
    return struct.pack(f"<{len(numbers)}d", *[number + 0.0 for number in numbers])
