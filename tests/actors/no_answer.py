"""A safety service that does not answer."""

from collections.abc import Sequence
from typing import NoReturn

from brakeline.errors import NoReply
from brakeline.messaging import brakeline_pb2 as pb


def no_answer(requests: Sequence[pb.Request]) -> NoReturn:
    raise NoReply("gone")
