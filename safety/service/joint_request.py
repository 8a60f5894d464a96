"""Requests of robots that share a world: the order of the decisions, and the reservations that each is checked against.

The service keeps nothing about a robot. A request carries the robot's current reservation, and the tubes of the robots
decided before in the same batch replace theirs. If a later one without a verified plan touches a robot that was decided
before, the service decides that robot again. So a batch must hold all robots of a world. If one is missing, the
service refuses the whole world, and all its robots brake inside their reservations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from brakeline.errors import AskedApart
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.reservation import OtherReservations, Reservation


def check_fleet(requests: Sequence[pb.Request]) -> None:
    """Check the requests of one world.

    Raises:
        AskedApart: the requests are not about all robots of the fleet, each once, at the same step.
    """
    wanted = requests[0].fleet
    if len(set(wanted)) != len(wanted):
        raise AskedApart("a robot is named twice in its fleet")
    actors = Counter(request.actor for request in requests)
    if twice := sorted(name for name, count in actors.items() if count > 1):
        raise AskedApart(f"{', '.join(twice)}: two requests in one batch")
    if foreign := sorted(actors.keys() - set(wanted)):
        raise AskedApart(f"{', '.join(foreign)}: not in the fleet that the request names")
    if missing := sorted(set(wanted) - actors.keys()):
        raise AskedApart(
            f"{', '.join(missing)}: in the fleet, but not in this batch; put all robots of a fleet into one batch: "
            "until then, each brakes along its backup plan"
        )
    if len({(request.robot, request.episode, request.step) for request in requests}) > 1:
        raise AskedApart("the requests of a fleet must be about robots of one kind at the same step")


def group_by_fleet(requests: Sequence[pb.Request]) -> list[list[int]]:
    """Return the indices of a batch's requests in the order of the decisions, one list for each world.

    The first robot of a world changes with the step, so that no robot is always last.
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


def other_reservations(name: str, reservations: Mapping[str, Reservation] | None) -> OtherReservations | None:
    """Return the reservations of the other robots; None without any, or for a robot without a fleet."""
    if reservations is None:
        return None
    return OtherReservations.to([reservation for other, reservation in reservations.items() if other != name])


def touches_another(name: str, reservations: Mapping[str, Reservation]) -> bool:
    """Return whether the robot's reservation touches another robot's."""
    others = other_reservations(name, reservations)
    return others is not None and others.touch(reservations[name])
