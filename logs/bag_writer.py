"""Record the messages of a ROS 2 node as a bag: a folder with `metadata.yaml` and an MCAP file with `ros2msg` schemas.

The `rosbags` package writes it; `ros2 bag`, Foxglove and other programs read it.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import Self

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter

from brakeline.messaging import ros2
from brakeline.messaging.ros2.cdr_messages import definition_of, digest_of, type_of

log = logging.getLogger("brakeline.bag")

PERIOD = 1.0  # s between flushes: the most that a killed process loses
FOREVER = QosTime(sec=9223372036, nsec=854775807)


class BagWriter:
    """Records to a new folder; a `brakeline.messaging.ros2.MessageTap`.

    Raises:
        OSError: the folder exists or cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError as error:
            raise FileExistsError(str(error)) from error
        self._topics: dict[tuple[str, str], Connection] = {}
        self._lock = threading.Lock()
        self._flushed = time.monotonic()
        self._failed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._failed = True  # ignore later messages
            try:
                self._writer.close()
            except OSError as failure:
                log.error("cannot finish %s: %s", self.folder, failure)

    def __call__(self, topic: str, kind: type, payload: bytes, at: int, qos: ros2.Qos) -> None:
        """Record one message. A full disk ends the recording with one error message; the robot drives on."""
        with self._lock:
            if self._failed:
                return
            try:
                self._writer.write(self._connection(topic, kind, qos), at, payload)
                self.count += 1
                if time.monotonic() - self._flushed > PERIOD:
                    self._flushed = time.monotonic()
                    self._flush()
            except OSError as error:
                self._failed = True
                log.error("RECORDING STOPPED: %s", error)

    def _connection(self, topic: str, kind: type, qos: ros2.Qos) -> Connection:
        name = type_of(kind)
        if (topic, name) not in self._topics:
            definition, digest, profiles = definition_of(kind), digest_of(kind), [_profile(qos)]
            self._topics[topic, name] = self._writer.add_connection(
                topic, name, msgdef=definition, rihs01=digest, offered_qos_profiles=profiles
            )
        return self._topics[topic, name]

    def _flush(self) -> None:
        """Flush the recorded messages to the operating system."""
        storage = self._writer.storage
        assert isinstance(storage, McapWriter)
        storage.close_chunk()
        storage.bio.flush()


def _profile(qos: ros2.Qos) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=qos.depth,
        reliability=QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if qos.latched else QosDurability.VOLATILE,
        deadline=FOREVER,
        lifespan=FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=FOREVER,
        avoid_ros_namespace_conventions=False,
    )
