"""Plan tokens: a service's proof that it verified a plan. An actor returns the token with its next request.

The service keeps nothing about a robot, so a request must state what the service decided before. A decision on a plan
u_0 .. u_{N-1} comes with a token for each of the next periods, until the plan ends. The k-th token is a MAC
(HMAC-SHA-256, 16 bytes) of what the request will hold k periods later if no better plan comes in between:

    names | u_{k-1} (the input in force), u_k .. u_{N-1}, stop .. stop (the tail) | prediction, if k = 1.

The names are those of the robot, the asker, the actor and the model. The asker is the process that asks, by its
certificate: nobody else can use its tokens. So a request needs one token, and the service computes one MAC to check it.
All replicas of a service share the key.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import struct
from collections.abc import Sequence
from pathlib import Path

from brakeline.errors import BadKeys
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.atomic_files import write_secret
from brakeline.messaging.robot import FEEDBACK, HOLD, Robot
from brakeline.safety.filter.backup_plan import UNVERIFIED

log = logging.getLogger("brakeline.safety")

SIZE = 16  # bytes of a token
KEY_FILE = "vouchers.key"  # in the folder of keys
KEY_SIZE = 32  # bytes, at least


def write_key(folder: Path) -> None:
    """Write a new key, if the folder has none yet."""
    if not (folder / KEY_FILE).exists():
        write_secret(folder / KEY_FILE, secrets.token_bytes(KEY_SIZE))


class PlanAuthenticator:
    """Issues plan tokens, and checks those of requests."""

    def __init__(self, key: bytes) -> None:
        if len(key) < KEY_SIZE:
            raise BadKeys(f"the key of the plan tokens has {len(key)} bytes; it needs {KEY_SIZE}")
        self._mac_of_nothing = hmac.new(key, digestmod="sha256")  # a copy of it takes half of the time of a new one

    @classmethod
    def of(cls, folder: Path | None) -> PlanAuthenticator:
        """Return an authenticator with the key in a folder, or with a new random key if the folder has none.

        Raises:
            BadKeys: the key is too short.
            OSError: the key can't be read.
        """
        if folder is not None and (folder / KEY_FILE).exists():
            return cls((folder / KEY_FILE).read_bytes())
        if folder is not None:
            log.info("no %s among the keys: plans that another replica verified count as unverified here", KEY_FILE)
        return cls(secrets.token_bytes(KEY_SIZE))

    def plan_tokens(self, request: pb.Request, decision: pb.Decision, robot: Robot, asker: str = "") -> list[bytes]:
        """Return the tokens of a decision, one for each of the next periods.

        The last token stays valid, since from there on the plan's tail no longer changes.
        """
        m, n = robot.action_dim, robot.horizon
        plan = decision.plan[:]
        stop = [0.0 if robot.stop[j] != HOLD else plan[j - m] for j in range(m)]
        moving = n  # periods until the plan stops
        while moving > 0 and plan[(moving - 1) * m : moving * m] == stop:
            moving -= 1
        inputs = plan + stop * (n + 1)
        tails, row = _bytes(inputs), 8 * m
        in_force = tails if FEEDBACK not in robot.stop else _bytes(_without_feedback(inputs, robot))
        names, predicted = _names(robot.name, asker, request.actor, decision.model), _prediction(decision)
        tokens = []
        for k in range(1, max(2, 1 + moving) + 1):
            message = names + in_force[(k - 1) * row : k * row] + tails[k * row : (k + n) * row]
            tokens.append(self._mac(message + predicted if k == 1 else message))
        return tokens

    def is_authentic(self, request: pb.Request, robot: Robot, asker: str = "") -> bool:
        """Return whether a request's token proves that the named model verified its plan, or it names no model."""
        if request.model in ("", UNVERIFIED):
            return True
        if len(request.input_in_force) != robot.action_dim:
            return False
        return hmac.compare_digest(self.plan_token(request, robot, asker), request.plan_token)

    def plan_token(self, request: pb.Request, robot: Robot, asker: str = "") -> bytes:
        in_force = _bytes(_without_feedback(request.input_in_force, robot))
        message = _names(robot.name, asker, request.actor, request.model) + in_force + _bytes(request.plan)
        if request.predicted_center or request.predicted_half_width:
            message += _prediction(request)
        return self._mac(message)

    def _mac(self, message: bytes) -> bytes:
        mac = self._mac_of_nothing.copy()
        mac.update(message)
        return mac.digest()[:SIZE]


def _names(robot: str, asker: str, actor: str, model: str) -> bytes:
    return repr((robot, asker, actor, model)).encode()


def _without_feedback(inputs: Sequence[float], robot: Robot) -> Sequence[float]:
    """Return rows of inputs, with zeros for those that feedback computes from the state."""
    if FEEDBACK not in robot.stop:
        return inputs
    m = robot.action_dim
    return [0.0 if robot.stop[i % m] == FEEDBACK else value for i, value in enumerate(inputs)]


def _prediction(message: pb.Request | pb.Decision) -> bytes:
    return _bytes([*message.predicted_center, *message.predicted_half_width, message.predicted_heading])


def _bytes(numbers: Sequence[float]) -> bytes:
    """Return the numbers as little-endian doubles, with -0 as +0."""
    return struct.pack(f"<{len(numbers)}d", *[number + 0.0 for number in numbers])
