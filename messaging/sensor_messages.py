"""What a ranging sensor saw, in messages: a fan in the plane, or an image all about."""

from __future__ import annotations

import numpy as np

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import BadScan, BeamTracks, Scan

RangeMeasurement = Scan | RangeImage

MILLI = 1e-3  # m: of what an image's ranges are multiples, rounded down
MOST = 65_535  # of them


def set_measurement(request: pb.Request, sensed: RangeMeasurement | None) -> None:
    """Put it into a request."""
    if isinstance(sensed, Scan):
        request.scan.CopyFrom(scan_message(sensed))
    elif sensed is not None:
        request.image.CopyFrom(image_message(sensed))


def measurement_in(request: pb.Request) -> RangeMeasurement | None:
    """What a request holds. Raises BadScan: it is none, or two."""
    scan, image = request.HasField("scan"), request.HasField("image")
    if scan and image:
        raise BadScan("a request has a scan or a range image, not both")
    if scan:
        return scan_of(request.scan)
    return image_of(request.image) if image else None


def scan_message(scan: Scan) -> pb.Scan:
    return pb.Scan(
        ranges=scan.ranges.astype(np.float32).tolist(),
        angles=scan.angles.astype(np.float32).tolist(),
        pose=scan.pose,
        mount=scan.mount,
        far=scan.far,
        range_error=scan.range_error,
        position_error=scan.position_error,
        heading_error=scan.heading_error,
        least_width=scan.least_width,
        doubt=scan.doubt,
        speed=scan.speed,
        age=scan.age,
        acceleration=scan.acceleration,
        least_radius=scan.least_radius,
        which=b"" if scan.tracks is None else scan.tracks.track_index.tobytes(),
        ways=[] if scan.tracks is None else scan.tracks.motions.ravel().tolist(),
    )


def scan_of(m: pb.Scan) -> Scan:
    """Raises BadScan: it is none."""
    if len(m.pose) != 3 or len(m.mount) != 2:
        raise BadScan("a scan's pose has 3 coordinates, its mount 2")
    if len(m.ways) % 4:
        raise BadScan("a scan's ways have four numbers each")
    tracks = None
    if m.which:
        tracks = BeamTracks(np.frombuffer(m.which, np.uint8), np.array(m.ways, dtype=float).reshape(-1, 4))
    x, y, heading = m.pose
    return Scan(
        np.fromiter(m.ranges, np.float64, len(m.ranges)),  # `np.array` takes five times as long
        np.fromiter(m.angles, np.float64, len(m.angles)),
        (x, y, heading),
        (m.mount[0], m.mount[1]),
        far=m.far,
        range_error=m.range_error,
        position_error=m.position_error,
        heading_error=m.heading_error,
        least_width=m.least_width,
        doubt=m.doubt,
        speed=m.speed,
        age=m.age,
        acceleration=m.acceleration,
        least_radius=m.least_radius,
        tracks=tracks,
    )


def image_message(image: RangeImage) -> pb.RangeImage:
    ranges = np.minimum(image.ranges / MILLI + 1e-6, MOST).astype("<u2")
    return pb.RangeImage(
        ranges=ranges.tobytes(),
        rings=len(ranges),
        low=image.low,
        high=image.high,
        at=image.at,
        attitude=image.attitude,
        mount=image.mount,
        far=image.far,
        range_error=image.range_error,
        position_error=image.position_error,
        angle_error=image.angle_error,
        least_width=image.least_width,
        doubt=image.doubt,
        speed=image.speed,
        age=image.age,
    )


def image_of(m: pb.RangeImage) -> RangeImage:
    """Raises BadScan: it is none."""
    if (len(m.at), len(m.attitude), len(m.mount)) != (3, 4, 3):
        raise BadScan("a range image's place and mount have 3 coordinates, its attitude 4")
    if not m.rings or not m.ranges or len(m.ranges) % (2 * m.rings):
        raise BadScan("a range image has two bytes for each beam, and as many beams in every ring")
    w, x, y, z = m.attitude
    return RangeImage(
        np.frombuffer(m.ranges, "<u2").reshape(m.rings, -1) * MILLI,
        (m.at[0], m.at[1], m.at[2]),
        (w, x, y, z),
        low=m.low,
        high=m.high,
        mount=(m.mount[0], m.mount[1], m.mount[2]),
        far=m.far,
        range_error=m.range_error,
        position_error=m.position_error,
        angle_error=m.angle_error,
        least_width=m.least_width,
        doubt=m.doubt,
        speed=m.speed,
        age=m.age,
    )
