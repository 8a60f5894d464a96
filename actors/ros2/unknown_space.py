"""Where a laser scan shows nothing: boxes for space that neither this scan nor an earlier one shows to be free.

A beam without information leaves a gap between its neighbours. As in a `Scan` with dropped beams, the gap is free up to
a distance F (`safety/perception/scan_coverage.py`): up to there, an obstacle of the least width would reach into a
beam beside the gap. The visibility memory extends F by what the scans of the last seconds showed to be free. Beyond F
the gap counts as occupied. A turn of the robot against the lidar's turn also leaves a gap, between the last beam and
the first.

Most lidars of ground robots do not see all round, or see a mast of the robot. In a *blind* direction, no scan has had
information since the start. There, two seconds are too short: a robot that stands would soon know nothing of what is
behind it. If someone states which space is free at the start (`SensorSettings.free_at_start`), a `GridMemory` keeps it
for the blind directions, with what the scans showed since. In all other directions the two seconds stay.

If unknown space comes as near as the body, the scan is refused: the filter would lead the robot away from it, and
nobody knows whether something touches the robot there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brakeline.actors.ros2.laser_beams import LaserBeams
from brakeline.actors.ros2.laser_obstacles import EXTRA_SIGHT, HitErrors
from brakeline.actors.ros2.sensor_frames import PlanarPose
from brakeline.errors import BadScan, Mismatch
from brakeline.messaging.obstacle import BOX, Obstacle, Shapes
from brakeline.messaging.robot import Array, Robot
from brakeline.messaging.scan import MAX_BEAMS, Scan
from brakeline.safety.perception.grid_memory import KEPT, GridMemory
from brakeline.safety.perception.scan_coverage import gaps
from brakeline.safety.perception.visibility_memory import FanMemory

FEWER_BEAMS = MAX_BEAMS // 2  # of a scan with more, every second, third, … counts: gaps need room for added beams
MOST_GAP = math.radians(12.0)  # between two beams: nearly all space between those of a ring of sonars is unknown
LEFT_OUT = 1.5  # gaps of the scan: two neighbours that are farther apart leave out beams
WIDEST = math.radians(6.0)  # of a box; a wider gap has several
LONGEST = 2.0  # s for which a scan stays in the memory: what is dark may have been put there since
AT_SENSOR = 1e-3  # m: range of a beam that hit something too near to be measured
BLIND = -1.0  # m: range of a beam in a direction in which the sensor has never seen anything
SECTORS = 360  # of a turn, in which a sensor sees something or does not
ALIKE = 0.03  # m by which the free ranges of gaps in one box differ


class _RecentScans(FanMemory):
    """The last scans' memory. Of the space around the body, it takes only the body's own place as free."""

    START = 0.0

    def __init__(self, footprint: float, longest: float) -> None:
        super().__init__(footprint, longest)
        self.left_out: NDArray[np.bool_] = np.zeros(0, dtype=bool)  # beams of the next scan that are not filled in

    def _beams_to_fill(self, scan: Scan) -> NDArray[np.bool_]:
        return ~(scan.valid_beams | self.left_out)

    def _near_start(self, points: Array, scan: Scan, step: Array | float) -> NDArray[np.bool_]:
        away = np.linalg.norm(points - np.asarray(scan.pose[:2]), axis=-1)
        return np.asarray(away <= self._start_radius - scan.position_error - step)


class UnknownSpace:
    """The unknown space around one robot, and the memory of what its scans showed to be free."""

    def __init__(self, robot: Robot, errors: HitErrors, least_width: float, free_at_start: float = 0.0) -> None:
        """Begin with nothing known.

        Args:
            least_width: of all obstacles [m], see `Scan`.
            free_at_start: see `SensorSettings`.

        Raises:
            Mismatch: the disc that is free at the start is not larger than the body.
        """
        self._robot, self._errors, self._least_width = robot, errors, least_width
        self._memory, self._last = _RecentScans(robot.footprint, LONGEST), -math.inf  # s, of the last scan
        self._kept = GridMemory(robot.footprint, free_at_start) if free_at_start else None
        self._informed = np.zeros(SECTORS, dtype=bool)  # sectors of the sensor's turn in which it has seen something
        self._stated = free_at_start
        least = 1.2 * robot.footprint + 7.0 * errors.position  # of a disc in which, less all errors, a body can stand
        if 0.0 < free_at_start < least:
            raise Mismatch(
                f"a free disc of {free_at_start:g} m at the start is too small, because the body reaches "
                f"{robot.footprint:g} m: give {math.ceil(100.0 * least) / 100.0:g} m or more"
            )

    def reset(self) -> None:
        """Forget all space, also what was free at the start: the poses are in another frame from here on."""
        self._memory.reset()
        if self._kept is not None:
            self._kept.reset()
            self._stated = 0.0

    def boxes(self, beams: LaserBeams, poses: Array, mount: PlanarPose, around: Array) -> tuple[Obstacle, ...]:
        """Return boxes that hold all unknown space near a position, for the next scan.

        Args:
            beams, poses, mount, around: see `laser_obstacles.obstacles`.

        Raises:
            BadScan: unknown space comes as near as the body, or the beams are too few for a lidar's.
        """
        if beams.gap > MOST_GAP:
            gap, most = math.degrees(beams.gap), math.degrees(MOST_GAP)
            raise BadScan(f"beams {gap:.0f}° apart: those of a lidar are at most {most:.0f}°")
        scan, moved, blind = self._scan(beams, poses, mount)
        unknown = scan.angles[~scan.valid_beams]
        filled = self._filled(scan, blind, float(beams.times[-1]))
        if not len(unknown):
            return ()
        angles, width, free = gaps(_where_better(filled, scan))
        ends = np.searchsorted(unknown, angles - 1e-9), np.searchsorted(unknown, angles + width + 1e-9)
        beyond = np.searchsorted(unknown, angles + width + 1e-9 - math.tau)  # the last gap goes on after -π
        hidden = (ends[1] > ends[0]) | (beyond > 0)
        free = free - self._parallax(filled, moved, beams.gap, angles, width)
        boxes = self._boxes(filled, angles[hidden], width[hidden], np.maximum(free[hidden], 0.0))
        limit = self._robot.footprint + 2.0 * self._errors.position
        if boxes and float(Shapes.of(boxes, 2).distance(around[None]).min()) < limit:
            raise BadScan(_why(beams, len(unknown), len(scan.angles)) + self._advice(bool(blind.any())))
        return boxes

    def _filled(self, scan: Scan, blind: NDArray[np.bool_], time: float) -> Scan:
        """Return the scan with its unknown beams filled in from memory."""
        elapsed = min(max(time - self._last, 0.0), 2.0 * LONGEST)
        self._last = time
        self._memory.left_out = blind if self._kept is not None else np.zeros_like(blind)
        filled = self._memory.fill(scan, elapsed)
        if self._kept is None:
            return filled
        return replace(filled, ranges=np.where(blind, self._kept.fill(scan, elapsed).ranges, filled.ranges))

    def _advice(self, blind: bool) -> str:
        """Return what to do about a scan that is refused."""
        if not blind:
            return ""
        if self._kept is None:
            return (
                ". If the lidar does not see all round: look whether the space about the robot is free, and state it "
                "(--free-at-start)"
            )
        why = (
            f"nobody has seen the space there within the last {KEPT * self._robot.footprint:.1f} m of the way"
            if self._stated
            else "the poses jumped, so what was free before no longer counts"
        )
        return f". {why}: look whether the space about the robot is free, and start the node again"

    def _scan(self, beams: LaserBeams, poses: Array, mount: PlanarPose) -> tuple[Scan, Array, NDArray[np.bool_]]:
        """Return the beams as a scan from the middle one's pose, with an unknown beam for each that is left out.

        Also return the sensor's way (2,) [m] from first to last beam, and which beams are blind.
        """
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        sensor = poses[:, :2] + np.stack([cos * mount.x - sin * mount.y, sin * mount.x + cos * mount.y], axis=1)
        middle = len(poses) // 2
        x, y, heading = map(float, poses[middle, :3])
        shift = float(np.linalg.norm(sensor - sensor[middle], axis=1).max())
        sectors = np.floor(beams.angles * (SECTORS / math.tau)).astype(int) % SECTORS
        self._informed[sectors[beams.known | beams.too_near]] = True
        unknown = np.where(self._informed[sectors], 0.0, BLIND)
        angles = mount.yaw + beams.angles + poses[:, 2] - heading
        ranges = np.where(beams.known, np.maximum(np.nan_to_num(beams.ranges), AT_SENSOR), unknown)
        ranges[beams.too_near] = AT_SENSOR
        size = math.ceil(len(angles) / FEWER_BEAMS)
        angles, ranges = _thinned(*_ascending(angles, ranges, beams.gap), size)
        whole_turn = math.tau - abs(float(beams.angles[-1] - beams.angles[0])) <= LEFT_OUT * beams.gap
        angles, ranges = _completed(angles, ranges, size * beams.gap, 0.0 if whole_turn else BLIND)
        scan = Scan(
            np.maximum(ranges, 0.0),
            angles,
            (x, y, heading),
            (mount.x, mount.y),
            beams.farthest,
            self._errors.range,
            self._errors.position + shift,
            self._errors.heading,
            self._least_width,
        )
        return scan, np.asarray(sensor[-1] - sensor[0]), ranges < 0.0

    @staticmethod
    def _parallax(scan: Scan, moved: Array, gap: float, angles: Array, width: Array) -> Array:
        """Return what gaps lose of F [m], because the two beams beside a gap do not begin at one point.

        An obstacle has that much more room between them. The first and the last beam are a whole turn apart. Where the
        memory filled in beams, it left room for this.
        """
        side = scan.pose[2] + angles + 0.5 * width
        across = np.abs(moved[0] * np.sin(side) - moved[1] * np.cos(side))
        seam = angles + width > angles[0] + math.tau - 1e-9
        across = np.where(seam, across, across * width / math.tau)
        return np.where(width > LEFT_OUT * gap, across / np.sin(np.minimum(width, 0.5 * math.pi)), 0.0)

    def _boxes(self, scan: Scan, angles: Array, width: Array, free: Array) -> tuple[Obstacle, ...]:
        """Return boxes that hold the gaps from `free` on, as far as the filter looks."""
        far = self._robot.sight + EXTRA_SIGHT
        angles, width, free = _merged(angles, width, free)
        parts = np.maximum(np.ceil(width / WIDEST).astype(int), 1)
        gap = np.repeat(np.arange(len(angles)), parts)
        number = np.arange(len(gap)) - np.repeat(np.cumsum(parts) - parts, parts)
        width, free = width[gap] / parts[gap], free[gap]
        at, heading = scan.sensor()
        side = heading + angles[gap] + (number + 0.5) * width
        arm = math.hypot(*scan.mount)
        boxes = []
        for middle, half, near in zip(side.tolist(), (0.5 * width).tolist(), free.tolist(), strict=True):
            if near >= far:
                continue
            error = scan.position_error + scan.heading_error * (far + arm)
            begin = near * math.cos(half) - scan.position_error - scan.heading_error * (near + arm)
            length, across = far - begin, 2.0 * (far * math.sin(half) + error)
            center = 0.5 * (far + begin)
            x, y = float(at[0]) + center * math.cos(middle), float(at[1]) + center * math.sin(middle)
            boxes.append(Obstacle(BOX, (x, y), (length, across), middle))
        return tuple(boxes)


def _where_better(filled: Scan, scan: Scan) -> Scan:
    """Return the filled scan without the beams of which the memory knows less than the beams beside them show."""
    if len(filled.angles) != len(scan.angles):
        return filled
    angles, _, free = gaps(scan)
    unknown = np.flatnonzero(~scan.valid_beams)
    ranges = filled.ranges.copy()
    ranges[unknown[ranges[unknown] - scan.range_error <= free[np.searchsorted(angles, scan.angles[unknown]) - 1]]] = 0.0
    return replace(filled, ranges=ranges)


def _merged(angles: Array, width: Array, free: Array) -> tuple[Array, Array, Array]:
    """Return fewer gaps: neighbours of about the same free range [m] become one of about `WIDEST`, with the least."""
    ends = angles + width
    begins = np.append(True, (np.abs(angles[1:] - ends[:-1]) > 1e-9) | (np.abs(np.diff(free)) > ALIKE))[: len(angles)]
    along = angles - angles[begins][np.cumsum(begins) - 1]
    begins |= np.append(False, np.diff(along // WIDEST) != 0.0)[: len(angles)]
    first = np.flatnonzero(begins)
    if not len(first):
        return angles, width, free
    last = np.append(first[1:], len(angles)) - 1
    return angles[first], ends[last] - angles[first], np.minimum.reduceat(free, first)


def _ascending(angles: Array, ranges: Array, gap: float) -> tuple[Array, Array]:
    """Return the beams in ascending order, within a turn: of two that look the same way, the later one counts."""
    if angles[-1] < angles[0]:
        last = angles > angles[-1] + math.tau - 0.5 * gap
        return angles[~last][::-1], ranges[~last][::-1]
    last = angles < angles[-1] - math.tau + 0.5 * gap
    return angles[~last], ranges[~last]


def _thinned(angles: Array, ranges: Array, size: int) -> tuple[Array, Array]:
    """Return one beam of each group of `size` neighbours: the first one with information, if there is one."""
    starts = np.arange(0, len(angles), size)
    index = np.minimum(starts[:, None] + np.arange(size), len(angles) - 1)
    chosen = index[np.arange(len(starts)), (ranges[index] > 0.0).argmax(axis=1)]
    return angles[chosen], ranges[chosen]


def _completed(angles: Array, ranges: Array, gap: float, unknown: float) -> tuple[Array, Array]:
    """Return the beams with unknown ones where some are left out; unknown: the range of those that have known sides."""
    step = np.diff(angles, append=angles[0] + math.tau)
    parts = np.where(step > LEFT_OUT * gap, np.rint(step / gap), 1.0).astype(int)
    beam = np.repeat(np.arange(len(step)), parts)
    number = np.arange(len(beam)) - np.repeat(np.cumsum(parts) - parts, parts)
    left_out = np.where((ranges < 0.0) & (np.roll(ranges, -1) < 0.0), BLIND, unknown)[beam]
    return angles[beam] + number * (step / parts)[beam], np.where(number == 0, ranges[beam], left_out)


def _why(beams: LaserBeams, unknown: int, directions: int) -> str:
    """Return why a scan is refused."""
    why = f"it has no information in {unknown} of {directions} directions, and nobody knows what is beside the robot"
    if beams.beyond:
        why += f" ({beams.beyond} ranges are above range_max, {beams.farthest:g} m: REP 117 wants inf for no hit)"
    return why
