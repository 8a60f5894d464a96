"""PROCESS: record every recorded topic in the run's MCAP log, as the bytes from the wire.

Subscribers only put samples into an inbox; one thread writes the inbox to the file twice a second. So `kill -9` loses
less than a second. While the disk is full, the inbox grows up to its limit; the recorder counts and reports the samples
that it drops. When a file is large or old, the recorder finishes it and continues in the next one.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from brakeline.logs.segment import Attachments, Entry, Metadata, Segment, open_segment
from brakeline.logs.segment_rotation import Rotation
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.bus.inbox import Inbox, size_in_memory
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import RECORDED

log = logging.getLogger("brakeline.recorder")

PERIOD = 0.5  # s between flushes
RETRY = 1.0  # s between attempts to write to a full disk
QUIET = 0.3  # s without a message after which a stopping recorder ends
PATIENCE = 3.0  # s that a stopping recorder waits for this at most
MOST_DRAWING = 2.0  # s of one flush after which the remaining messages are recorded without scenes

Derive = Callable[[Sample], Iterable[Entry]]  # additional entries for a sample, e.g. Foxglove's scenes


@dataclass(frozen=True)
class LogSettings:
    """What a recorder writes.

    Attributes:
        run: path of the log.
        metadata, attachments: written to each file of the log.
        derive: returns additional entries for a sample.
    """

    run: Path
    metadata: Metadata = field(default_factory=dict)
    attachments: Attachments = field(default_factory=dict)
    derive: Derive = lambda sample: ()
    rotation: Rotation = field(default_factory=Rotation)


class Recording:
    """Writes an inbox to the segments of a run, on a disk that may fill up. Use it from one thread only.

    Attributes:
        recorded: number of messages in the files, by key.
        undrawn: number of messages without scenes, because drawing took too long.
        failure: why the recorder cannot write now; empty if it can.
        path: of the latest segment.
    """

    def __init__(self, settings: LogSettings, inbox: Inbox, rejected: RejectedMessages | None = None) -> None:
        self.recorded: Counter[str] = Counter()
        self.undrawn = 0
        self.failure = ""
        self.path: Path | None = None
        self._settings, self._inbox, self._rejected = settings, inbox, rejected or RejectedMessages()
        self._segment: Segment | None = None
        self._opened_at = self._retry_at = self._flush_began = 0.0
        self._reported_drops = 0

    def save(self) -> None:
        """Write the inbox to the file and flush it; what cannot be written stays in the inbox."""
        self._report_drops()
        self._flush_began = time.monotonic()
        if time.monotonic() < self._retry_at:
            return
        try:
            segment = self._current_segment()
            waiting = self._inbox.bytes
            while waiting > 0 and (batch := self._inbox.oldest()):
                left_out = segment.save([item for sample in batch for item in self._entries(sample)])
                if left_out:
                    self._rejected.reject(
                        batch[-1].key, ValueError(f"{left_out} messages on channels beyond the limit of a file")
                    )
                waiting -= sum(size_in_memory(sample) for sample in batch)
                self._inbox.remove(batch)
                self.recorded.update(sample.key for sample in batch)
                segment = self._rotated(segment)
            self._rotated(segment)
        except OSError as error:
            self._fail(error)
        else:
            self.failure = ""

    def finish(self) -> None:
        """Write the rest of the inbox and close the file with its summary."""
        self._retry_at = 0.0
        self.save()
        self._close(sync=True)
        if self._inbox.bytes:
            size = self._inbox.bytes
            log.error("%d bytes of messages could not be recorded: %s", size, self.failure)
            while batch := self._inbox.oldest():
                self._inbox.remove(batch)
                self._inbox.dropped.update(sample.key for sample in batch)

    def _entries(self, sample: Sample) -> list[Entry]:
        """Return the entries of a sample: itself, also if it is malformed, and what `derive` adds."""
        try:
            if time.monotonic() - self._flush_began <= MOST_DRAWING:
                return [entry(sample), *self._settings.derive(sample)]
            if not self.undrawn:
                log.warning("messages arrive faster than they can be drawn: some are recorded without scenes")
            self.undrawn += 1
            return [entry(sample)]
        except Exception as error:  # its bytes are kept all the same
            self._rejected.reject(sample.key, error)
            return [Entry(sample.key, sample.topic.message, sample.payload, sample.received, sample.received, 0)]

    def _current_segment(self) -> Segment:
        """Return the file to write to; open a new one if needed. Raises OSError."""
        if self._segment is None:
            settings = self._settings
            self._segment = open_segment(settings.run, settings.metadata, settings.attachments)
            self._opened_at = time.monotonic()
            self.path = self._segment.path
            log.log(logging.WARNING if self.failure else logging.INFO, "recording to %s", self.path)
        return self._segment

    def _rotated(self, segment: Segment) -> Segment:
        """Return the file to continue with: a new one if rotation is due. Raises OSError."""
        if not self._settings.rotation.due(segment, time.monotonic() - self._opened_at):
            return segment
        self._close()
        return self._current_segment()

    def _close(self, sync: bool = False) -> None:
        """Finish the open file, if there is one."""
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                segment.finish(sync)
            except OSError as error:
                log.error("no summary for %s: %s; `brakeline analyse` reads the file nevertheless", segment.path, error)

    def _fail(self, error: OSError) -> None:
        self._retry_at = time.monotonic() + RETRY
        if not self.failure:
            log.error("NOT RECORDING: %s; up to %d MiB wait in memory", error, self._inbox.limit >> 20)
        self.failure = str(error)
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _report_drops(self) -> None:
        dropped = self._inbox.dropped.total()
        if dropped > self._reported_drops:
            log.error("%d messages were dropped so far: %s", dropped, self.failure or "too many to write")
            self._reported_drops = dropped


def entry(sample: Sample) -> Entry:
    """Return a sample's entry. Raises Malformed."""
    header = sample.message().header
    publish_time = round(header.time * 1e9) if header.time > 0.0 else header.wall_time
    return Entry(sample.key, sample.topic.message, sample.payload, sample.received, publish_time, header.sequence)


def main(settings: BusSettings, log_settings: LogSettings, source: str = "recorder") -> None:
    """Record until a signal stops the process and no more messages arrive.

    Health messages have the figures `recorded`, `dropped` and `undrawn` (messages), `waiting` (bytes), `recorded <key>`
    for each channel, and the notes `file` and `failure` (why the recorder cannot write).
    """
    with Process(settings, source) as process:
        inbox = Inbox()
        recording = Recording(log_settings, inbox, process.bus.rejected)

        def refresh() -> None:
            process.figures.update(
                {f"recorded {key}": float(count) for key, count in recording.recorded.copy().items()},
                recorded=float(recording.recorded.total()),
                dropped=float(inbox.dropped.total()),
                undrawn=float(recording.undrawn),
                waiting=float(inbox.bytes),
            )
            process.notes.update(file=str(recording.path or ""), failure=recording.failure)

        subscriptions = [process.bus.subscribe(topic, inbox.put) for topic in RECORDED]
        recording.save()
        process.refresh = refresh
        process.announce()
        while not process.stop.wait(PERIOD):
            recording.save()
        _until_quiet(inbox, recording)
        for subscription in subscriptions:
            subscription.close()
        recording.finish()
        dropped = inbox.dropped.total()
        level = logging.ERROR if dropped else logging.INFO
        log.log(level, "recorded %d messages to %s, dropped %d", recording.recorded.total(), recording.path, dropped)


def _until_quiet(inbox: Inbox, recording: Recording) -> None:
    """Wait for the last messages of processes that stopped just before."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        recording.save()
        time.sleep(QUIET)
        if not inbox.bytes:
            return
