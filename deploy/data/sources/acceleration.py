"""Accelerations in the world, out of what accelerometers feel along a body and how that was turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Array, Table

FORCE = tuple(f"force.{axis}" for axis in AXES)  # m/s², felt forward, right, down
ATTITUDE = ("attitude.yaw", "attitude.pitch", "attitude.roll")  # rad, one after the other, from NED to that frame
GRAVITY = 9.80665  # m/s²
APART = 0.5  # s between two attitudes, at most, to know one in between


def add_accelerations(tables: Sequence[Table]) -> list[Table]:
    """The same tables; those with a force have the acceleration that it shows, where an attitude is known then."""
    attitudes = min((t for t in tables if ATTITUDE[0] in t.columns), key=lambda t: t.rank, default=None)
    if attitudes is None or len(attitudes.time) < 2:
        return list(tables)
    return [
        replace(t, columns=t.columns | _accelerations(t, attitudes)) if FORCE[0] in t.columns else t for t in tables
    ]


def _accelerations(felt: Table, attitudes: Table) -> dict[str, Array]:
    time, own = felt.time, attitudes.time
    angles = [np.interp(time, own, np.unwrap(attitudes.columns[name])) for name in ATTITUDE]
    force = np.column_stack([felt.columns[name] for name in FORCE])
    north, east, down = Rotation.from_euler("ZYX", np.column_stack(angles)).apply(force).T
    after = np.searchsorted(own, time)
    inside = (after > 0) & (after < len(own))
    after = np.clip(after, 1, len(own) - 1)
    known = inside & (own[after] - own[after - 1] < APART)
    values = (east, north, -down - GRAVITY)
    return {f"acceleration.{axis}": np.where(known, value, np.nan) for axis, value in zip(AXES, values, strict=True)}
