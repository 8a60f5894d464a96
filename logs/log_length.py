"""Count the messages of a log, from the summaries of its files where there are any."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

from brakeline.logs.mcap_container import BROKEN, has_whole_summary
from brakeline.logs.reader import Log, Paths, find
from brakeline.messaging.topics import Topic


def count(paths: Paths, topic: Topic) -> int | None:
    """Return the number of messages of a topic; None if a file has no summary because its recorder was killed.

    Raises:
        LogError: a path has no log.
    """
    root, total = topic.key.split("/", 1)[0], 0
    for path in find(paths):
        if (counts := _in_summary(path)) is None:
            return None
        total += sum(messages for key, messages in counts.items() if key.split("/", 1)[0] == root)
    return total


def count_by_key(path: Path) -> Counter[str]:
    """Return the number of messages in a file at each key. A file without a summary is read from front to back.

    Raises:
        LogError: the file is no log.
        OSError: it cannot be read.
    """
    if (counts := _in_summary(path)) is not None:
        return counts
    return Counter(channel.key for channel, *_ in Log((path,)).rows())


def _in_summary(path: Path) -> Counter[str] | None:
    """Return the number of messages at each key by the file's summary; None if it has none."""
    with path.open("rb") as file:
        if not has_whole_summary(file, path.stat().st_size):
            return None
        file.seek(0)
        try:
            summary = make_reader(file).get_summary()
        except BROKEN:
            return None
    if summary is None or summary.statistics is None:
        return None
    counts: Counter[str] = Counter()
    for number, messages in summary.statistics.channel_message_counts.items():
        if (channel := summary.channels.get(number)) is None:
            return None
        counts[channel.topic] += messages
    return counts
