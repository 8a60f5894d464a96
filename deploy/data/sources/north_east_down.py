"""Convert the quantities of autopilots from NED to ENU (`quantity_names`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from brakeline.deploy.data.sources.message_tables import Columns
from brakeline.deploy.data.sources.quantity_names import AXES
from brakeline.deploy.data.sources.source_table import Array, Table

FORCE = tuple(f"force.{axis}" for axis in AXES)  # m/s², specific force: forward, right, down
ATTITUDE = ("attitude.yaw", "attitude.pitch", "attitude.roll")  # rad, intrinsic rotations from NED to the body
GRAVITY = 9.80665  # m/s²
MAX_GAP = 0.5  # s between two attitudes for interpolation


def enu(kind: str, columns: Columns, names: Sequence[str], unit: float = 1.0) -> Columns:
    """Return the vector `kind` in ENU from columns north, east and down; empty if one is missing."""
    if any(name not in columns for name in names):
        return {}
    north, east, down = (unit * columns[name] for name in names)
    return {f"{kind}.x": east, f"{kind}.y": north, f"{kind}.z": -down}


def along_body(velocity: Columns, yaw_in_ned: Array) -> Columns:
    """Return the yaw, and the velocity forward, left and up."""
    yaw = np.pi / 2.0 - yaw_in_ned
    x, y, z = (velocity[f"velocity.{axis}"] for axis in AXES)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return {"yaw": yaw, "body.x": cos * x + sin * y, "body.y": cos * y - sin * x, "body.z": z}


def force(columns: Columns, names: Sequence[str], unit: float = 1.0) -> Columns:
    """Return the specific force from columns forward, right and down."""
    return {name: unit * columns[column] for name, column in zip(FORCE, names, strict=True)}


def add_accelerations(tables: Sequence[Table]) -> list[Table]:
    """Add accelerations (NaN without an attitude) to the tables that contain specific forces."""
    attitudes = min((t for t in tables if ATTITUDE[0] in t.columns), key=lambda t: t.rank, default=None)
    if attitudes is None or len(attitudes.time) < 2:
        return list(tables)
    return [
        replace(t, columns=t.columns | _accelerations(t, attitudes)) if FORCE[0] in t.columns else t for t in tables
    ]


def _accelerations(felt: Table, attitudes: Table) -> Columns:
    time, known_at = felt.time, attitudes.time
    yaw, pitch, roll = (np.interp(time, known_at, np.unwrap(attitudes.columns[name])) for name in ATTITUDE)
    north, east, down = _into_ned([felt.columns[name] for name in FORCE], yaw, pitch, roll)
    after = np.searchsorted(known_at, time)
    inside = (after > 0) & (after < len(known_at))
    after = np.clip(after, 1, len(known_at) - 1)
    known = inside & (known_at[after] - known_at[after - 1] < MAX_GAP)
    values = (east, north, -down - GRAVITY)
    return {f"acceleration.{axis}": np.where(known, value, np.nan) for axis, value in zip(AXES, values, strict=True)}


def _into_ned(forces: Sequence[Array], yaw: Array, pitch: Array, roll: Array) -> tuple[Array, Array, Array]:
    """Rotate vectors (forward, right, down) of the body into north, east, down: by roll, then pitch, then yaw."""
    forward, right, down = forces
    right, down = np.cos(roll) * right - np.sin(roll) * down, np.sin(roll) * right + np.cos(roll) * down
    forward, down = np.cos(pitch) * forward + np.sin(pitch) * down, np.cos(pitch) * down - np.sin(pitch) * forward
    return np.cos(yaw) * forward - np.sin(yaw) * right, np.sin(yaw) * forward + np.cos(yaw) * right, down
