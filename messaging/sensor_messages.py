"""Convert measurements of range sensors, scans and range images, to messages and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from brakeline.errors import BadScan
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import BeamTracks, Scan

RangeMeasurement = Scan | RangeImage

RANGE_STEP = 1e-3  # resolution of the ranges of an image in a message, rounded down [m]
MAX_RANGE_STEPS = 65_535
# Fields that have the same name and form in the class and in the message.
SHARED_FIELDS = ("far", "range_error", "position_error", "least_width", "doubt", "speed", "age")
SCAN_FIELDS = (*SHARED_FIELDS, "heading_error", "acceleration", "least_radius")
IMAGE_FIELDS = (*SHARED_FIELDS, "at", "attitude", "mount", "angle_error", "low", "high")


def _values(source: Any, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


def set_measurement(request: pb.Request, measurement: RangeMeasurement | None) -> None:
    """Set the scan or the range image of a request."""
    if isinstance(measurement, Scan):
        request.scan.CopyFrom(scan_message(measurement))
    elif measurement is not None:
        request.image.CopyFrom(image_message(measurement))


def measurement_in(request: pb.Request) -> RangeMeasurement | None:
    """Return the scan or the range image of a request, if it has one.

    Raises:
        BadScan: the measurement is invalid, or the request has both.
    """
    scan, image = request.HasField("scan"), request.HasField("image")
    if scan and image:
        raise BadScan("a request has a scan or a range image, not both")
    if scan:
        return scan_of(request.scan)
    return image_of(request.image) if image else None


def scan_message(scan: Scan) -> pb.Scan:
    """Return the message of a scan."""
    return pb.Scan(
        ranges=scan.ranges.astype(np.float32).tolist(),
        angles=scan.angles.astype(np.float32).tolist(),
        pose=scan.pose,
        mount=scan.mount,
        which=b"" if scan.tracks is None else scan.tracks.track_index.tobytes(),
        ways=[] if scan.tracks is None else scan.tracks.motions.ravel().tolist(),
        **_values(scan, SCAN_FIELDS),
    )


def scan_of(message: pb.Scan) -> Scan:
    """Return the scan in a message. Raises BadScan: the scan is invalid."""
    if len(message.ways) % 4:
        raise BadScan("a scan's ways have four numbers each")
    tracks = None
    if message.which:
        motions = np.array(message.ways, dtype=float).reshape(-1, 4)
        tracks = BeamTracks(np.frombuffer(message.which, np.uint8), motions)
    pose: Any = tuple(message.pose)  # `Scan` checks the lengths
    mount: Any = tuple(message.mount)
    return Scan(
        np.fromiter(message.ranges, np.float64, len(message.ranges)),  # five times as fast as `np.array`
        np.fromiter(message.angles, np.float64, len(message.angles)),
        pose,
        mount,
        tracks=tracks,
        **_values(message, SCAN_FIELDS),
    )


def image_message(image: RangeImage) -> pb.RangeImage:
    """Return the message of a range image."""
    ranges = np.minimum(image.ranges / RANGE_STEP + 1e-6, MAX_RANGE_STEPS).astype("<u2")
    return pb.RangeImage(
        ranges=ranges.tobytes(),
        rings=len(ranges),
        **_values(image, IMAGE_FIELDS),
    )


def image_of(message: pb.RangeImage) -> RangeImage:
    """Return the range image in a message. Raises BadScan: the image is invalid."""
    if not message.rings or not message.ranges or len(message.ranges) % (2 * message.rings):
        raise BadScan("a range image has two bytes for each beam, and as many beams in every ring")
    ranges = np.frombuffer(message.ranges, "<u2").reshape(message.rings, -1) * RANGE_STEP
    ranges = np.minimum(ranges, max(0.0, message.far))  # a program may send the largest number for no hit
    return RangeImage(ranges, **_values(message, IMAGE_FIELDS))
