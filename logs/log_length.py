"""Count the messages of a log from the summaries of its files, for progress displays."""

from __future__ import annotations

from mcap.reader import make_reader

from brakeline.logs.mcap_container import BROKEN
from brakeline.logs.reader import Paths, find
from brakeline.messaging.topics import Topic


def count(paths: Paths, topic: Topic) -> int | None:
    """Return the number of messages of a topic; None if a file has no summary because its recorder was killed.

    Raises:
        LogError: a path has no log.
    """
    root, total = topic.key.split("/", 1)[0], 0
    for path in find(paths):
        with path.open("rb") as file:
            try:
                summary = make_reader(file).get_summary()
            except BROKEN:
                return None
        if summary is None or summary.statistics is None:
            return None
        for number, messages in summary.statistics.channel_message_counts.items():
            total += messages if summary.channels[number].topic.split("/", 1)[0] == root else 0
    return total
