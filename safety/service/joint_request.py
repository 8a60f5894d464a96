"""Robots of one world in one question: who is decided when, against whose promises, and who can't be.

The service keeps nothing: what each robot is committed to comes with the question, and the tubes of those decided
before in the same batch replace it. So all robots of a world have to be in the batch; if one is missing, or is asked
about by somebody else, nothing can be promised to the others, and all of them brake along what they promised before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.request import BadRequest
from brakeline.safety.filter.reservation import OtherReservations, Reservation


class AskedApart(BadRequest):
    """Robots of one world that are not all in one question: no promise can be made."""

    def __init__(self, message: str) -> None:
        super().__init__("fleet", message)


@dataclass
class FleetReservations:
    """The robots of one world in a batch: what each promises at this moment, by its actor's name."""

    names: tuple[str, ...]
    reservations: dict[str, Reservation] = field(default_factory=dict)

    def to(self, name: str) -> OtherReservations | None:
        """What the others promise to one of them."""
        return OtherReservations.to([reservation for other, reservation in self.reservations.items() if other != name])


def check_fleet(requests: Sequence[pb.Request]) -> None:
    """For one world's requests of a batch.

    Raises:
        AskedApart: they are not about all of its robots, each once, at the same step.
    """
    wanted = requests[0].fleet
    if len(set(wanted)) != len(wanted):
        raise AskedApart("a robot is named twice in its fleet")
    there = Counter(request.actor for request in requests)
    if twice := sorted(name for name, count in there.items() if count > 1):
        raise AskedApart(f"{', '.join(twice)}: asked about twice in one question")
    if foreign := sorted(there.keys() - set(wanted)):
        raise AskedApart(f"{', '.join(foreign)}: not of the fleet that is named")
    if missing := sorted(set(wanted) - there.keys()):
        raise AskedApart(
            f"{', '.join(missing)}: of this fleet, but not in this question: robots that are asked apart can't be "
            "promised anything, so each brakes along its plan"
        )
    if len({(request.robot, request.episode, request.step) for request in requests}) > 1:
        raise AskedApart("the robots of a fleet are of one kind, and asked about at the same step")


def group_by_fleet(requests: Sequence[pb.Request]) -> list[list[int]]:
    """The requests of a batch in the order in which they are decided, those of one world together.

    Robots of a world take turns: who is first moves on with the period's number, so that nobody is last for ever.
    """
    alone = [[i] for i, request in enumerate(requests) if not request.fleet]
    shared: dict[frozenset[str], list[int]] = {}
    for i, request in enumerate(requests):
        if request.fleet:
            shared.setdefault(frozenset(request.fleet), []).append(i)
    for members in shared.values():
        first = requests[members[0]].step % len(members)
        members[:] = members[first:] + members[:first]
    return alone + list(shared.values())


def joint_request(requests: Sequence[pb.Request], standing: Callable[[pb.Request], Reservation]) -> FleetReservations:
    """What the robots of one world are committed to before any of them is decided.

    standing: of a robot that has promised nothing yet; raises BadRequest unless it stands.

    Raises:
        AskedApart: not all of them are there. BadRequest: a promise is none.
    """
    check_fleet(requests)
    found = FleetReservations(tuple(request.actor for request in requests))
    for request in requests:
        found.reservations[request.actor] = standing(request)
    return found
