"""Query the safety service with requests, and check that the replies belong to them."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from google.protobuf.message import DecodeError

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus
from brakeline.messaging.topics import DECIDE
from brakeline.safety.service.wire import MAX_BATCH_SIZE, MAX_OBSTACLES, bad_reply, digest

NONCE = 16  # bytes


def query_service(bus: Bus, requests: Sequence[pb.Request], deadline: float) -> list[pb.Reply]:
    """Query the service with requests about robots of one kind, and return the replies in their order.

    Requests that are too large for one batch, such as those of many robots with range images, go in several. A fleet
    stays together, because the service decides about its robots at once.

    Args:
        deadline: longest wait for all replies [s].

    Raises:
        NoReply, Late, Refused: no service replied, or not in time, or it could not read the query.
        SafetyError: the reply is not a batch, has another number of replies, or belongs to another query.
    """
    payload = pb.RequestBatch(requests=requests, nonce=secrets.token_bytes(NONCE)).SerializeToString()
    if len(requests) > 1 and not requests[0].fleet and _is_too_large(payload, requests):
        half = len(requests) // 2
        parts = requests[:half], requests[half:]
        return [reply for part in parts for reply in query_service(bus, part, 0.5 * deadline)]
    answer = bus.ask(DECIDE, payload, deadline, robot=requests[0].robot)
    try:
        batch = pb.ReplyBatch.FromString(answer)
    except DecodeError as error:
        raise bad_reply("", f"not a reply batch: {error}") from error
    if batch.request != digest(payload):
        raise bad_reply("request", "replies to another query")
    if len(batch.replies) != len(requests):
        raise bad_reply("", f"{len(batch.replies)} replies to {len(requests)} requests")
    return list(batch.replies)


def _is_too_large(payload: bytes, requests: Sequence[pb.Request]) -> bool:
    return len(payload) > MAX_BATCH_SIZE or sum(len(request.obstacles) for request in requests) > MAX_OBSTACLES
