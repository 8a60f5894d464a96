"""Import pymavlink's `common` dialect as MAVLink 2."""

from __future__ import annotations

import os

os.environ.setdefault("MAVLINK20", "1")  # pymavlink reads it when it is imported

from pymavlink.dialects.v20 import common as mavlink

__all__ = ["mavlink"]
