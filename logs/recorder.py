"""PROCESS: stores every recorded topic, as the bytes that came from the wire, in the run's MCAP log.

Subscribers only put samples into an inbox; one thread empties it into the file twice a second. So a `kill -9` loses
less than a second. While the disk is full the inbox fills up; what no longer fits is counted as dropped, and said.
A file that has grown large or old is finished, and the log goes on in the next.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from brakeline.logs.segment import Attachments, Entry, Metadata, Segment, open_segment
from brakeline.logs.segment_rotation import Rotation as Rotation
from brakeline.messaging.bus import BusSettings, Sample
from brakeline.messaging.process_runtime import Process
from brakeline.messaging.rejected_messages import RejectedMessages
from brakeline.messaging.topics import RECORDED

log = logging.getLogger("brakeline.recorder")

PERIOD = 0.5  # s between flushes
RETRY = 1.0  # s between attempts to write on a disk that is full
QUIET = 0.3  # s without a message after which a recorder that was asked to stop has seen the last one
PATIENCE = 3.0  # s that it waits for this at most
INBOX = 64 * 2**20  # bytes
AROUND = 100  # bytes of a sample besides its payload
PORTION = 2**20  # bytes saved at once: what fits on a nearly full disk is saved
HURRY = 2.0  # s of one flush after which the messages that are left are saved as they came, without pictures

Open = Callable[[Path, Metadata], Segment]
Derive = Callable[[Sample], Iterable[Entry]]  # what is stored of a sample besides itself: Foxglove's pictures


def weight(sample: Sample) -> int:
    """Bytes that a sample takes in memory, at least: an empty one counts too."""
    return AROUND + len(sample.payload)


class Inbox:
    """Samples that are not in the file yet, at most `limit` bytes of them."""

    def __init__(self, limit: int = INBOX) -> None:
        self.limit = limit
        self.dropped: Counter[str] = Counter()  # per key
        self.bytes = 0
        self._samples: deque[Sample] = deque()
        self._lock = threading.Lock()

    def put(self, sample: Sample) -> None:
        """Take the sample, or count it as dropped."""
        with self._lock:
            if self.bytes + weight(sample) > self.limit:
                self.dropped[sample.key] += 1
            else:
                self.bytes += weight(sample)
                self._samples.append(sample)

    def portion(self, size: int = PORTION) -> list[Sample]:
        """The oldest samples, about `size` bytes of them; they stay until `forget`."""
        taken: list[Sample] = []
        total = 0
        with self._lock:
            for sample in self._samples:
                if taken and total + weight(sample) > size:
                    break
                taken.append(sample)
                total += weight(sample)
        return taken

    def forget(self, samples: list[Sample]) -> None:
        """Remove what `portion` gave: it is saved."""
        with self._lock:
            for sample in samples:
                self._samples.popleft()
                self.bytes -= weight(sample)


class Recording:
    """Empties an inbox into the segments of a run, on a disk that may fill up. For one thread."""

    def __init__(
        self,
        run: Path,
        metadata: Metadata,
        inbox: Inbox,
        open_one: Open = open_segment,
        derive: Derive | None = None,
        rotation: Rotation | None = None,
        rejected: RejectedMessages | None = None,
    ) -> None:
        self.recorded: Counter[str] = Counter()  # messages in the files, per key
        self.failure = ""  # why nothing can be written at present
        self.path: Path | None = None  # of the latest segment
        self._run, self._metadata, self._inbox, self._open = run, metadata, inbox, open_one
        self._derive = derive or (lambda sample: ())
        self._rotation = rotation or Rotation()
        self._rejected = rejected or RejectedMessages()
        self._segment: Segment | None = None
        self._begun_at = 0.0
        self._retry_at = 0.0
        self._complained_of = 0
        self.undrawn = 0  # messages of which nothing was derived: it would have taken too long
        self._flush_began = 0.0

    def save(self) -> None:
        """Bring what is in the inbox now to the operating system; what can't be written stays there."""
        self._complain_of_drops()
        self._flush_began = time.monotonic()
        if time.monotonic() < self._retry_at:
            return
        try:
            segment = self._begun()
            waiting = self._inbox.bytes
            while waiting > 0 and (portion := self._inbox.portion()):
                left_out = segment.save([item for sample in portion for item in self._entries(sample)])
                if left_out:
                    self._rejected.reject(portion[-1].key, ValueError(f"{left_out} messages of one channel too many"))
                waiting -= sum(weight(sample) for sample in portion)
                self._inbox.forget(portion)
                self.recorded.update(sample.key for sample in portion)
                segment = self._rotated(segment)
            self._rotated(segment)
        except OSError as error:
            self._fail(error)
        else:
            self.failure = ""

    def finish(self) -> None:
        """Save what is left, try hard, and close the file with its summary."""
        self._retry_at = 0.0
        self.save()
        self._close(sync=True)
        if self._inbox.bytes:
            log.error("%d bytes of messages could not be recorded: %s", self._inbox.bytes, self.failure)

    def _entries(self, sample: Sample) -> list[Entry]:
        """The sample, whatever it holds, and what is made of it, if there is time."""
        try:
            if time.monotonic() - self._flush_began > HURRY:
                self._leave_out()
                return [entry(sample)]
            return [entry(sample), *self._derive(sample)]
        except Exception as error:  # its bytes are kept all the same
            self._rejected.reject(sample.key, error)
            return [as_it_came(sample)]

    def _leave_out(self) -> None:
        if not self.undrawn:
            log.warning("messages come faster than they can be drawn: some are recorded without pictures")
        self.undrawn += 1

    def _begun(self) -> Segment:
        """The file to write to, a new one if there is none. Raises OSError."""
        if self._segment is None:
            self._segment, self._begun_at = self._open(self._run, self._metadata), time.monotonic()
            self.path = self._segment.path
            log.log(logging.WARNING if self.failure else logging.INFO, "recording to %s", self.path)
        return self._segment

    def _rotated(self, segment: Segment) -> Segment:
        """The file to go on with: the next one, if this one has had enough. Raises OSError."""
        if not self._rotation.due(segment, time.monotonic() - self._begun_at):
            return segment
        self._close()
        return self._begun()

    def _close(self, sync: bool = False) -> None:
        """Finish the file, if there is one."""
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                segment.finish(sync)
            except OSError as error:
                log.error("no summary for %s: %s; `analyse` reads it all the same", segment.path, error)

    def _fail(self, error: OSError) -> None:
        self._retry_at = time.monotonic() + RETRY
        if not self.failure:
            log.error("NOT RECORDING: %s; up to %d MiB wait in memory", error, self._inbox.limit >> 20)
        self.failure = str(error)
        if self._segment is not None:
            self._segment.abandon()
            self._segment = None

    def _complain_of_drops(self) -> None:
        dropped = self._inbox.dropped.total()
        if dropped > self._complained_of:
            log.error("%d messages were dropped so far: %s", dropped, self.failure or "too many to write")
            self._complained_of = dropped


def entry(sample: Sample) -> Entry:
    """A sample as it is stored. Raises Malformed."""
    header = sample.message().header
    publish_time = round(header.time * 1e9) if header.time > 0.0 else header.wall_time
    return Entry(sample.key, sample.topic.message, sample.payload, sample.received, publish_time, header.sequence)


def as_it_came(sample: Sample) -> Entry:
    """A sample that cannot be understood, published when it was received."""
    return Entry(sample.key, sample.topic.message, sample.payload, sample.received, sample.received, 0)


def record(
    process: Process,
    run: Path,
    metadata: Metadata,
    attachments: Attachments | None = None,
    derive: Derive | None = None,
    rotation: Rotation | None = None,
) -> Recording:
    """Record until `process.stop` is set and nothing more comes. Its Health has the note `file` once it listens.

    Health figures: `recorded`, `dropped` and `undrawn` messages, `waiting` bytes, and `recorded <key>` per channel; the
    note `failure` says why nothing can be written.
    """
    inbox = Inbox()
    opened = partial(open_segment, attachments=attachments)
    recording = Recording(run, metadata, inbox, opened, derive, rotation, process.bus.rejected)

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
    log.info("recorded %d messages to %s", recording.recorded.total(), recording.path)
    return recording


def _until_quiet(inbox: Inbox, recording: Recording) -> None:
    """Wait for the last messages of those who stopped just before."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        recording.save()
        time.sleep(QUIET)
        if not inbox.bytes:
            return


def main(
    settings: BusSettings,
    run: Path,
    metadata: Metadata,
    source: str = "recorder",
    attachments: Attachments | None = None,
    derive: Derive | None = None,
    rotation: Rotation | None = None,
) -> None:
    """The recorder's process: `run` is the log's path; metadata, attachments and what `derive` makes of the samples go
    into each of its files besides the messages."""
    with Process(settings, source) as process:
        record(process, run, metadata, attachments, derive, rotation)
