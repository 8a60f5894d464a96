"""pymavlink's `common` dialect, as MAVLink 2: the one place that imports it here."""

from __future__ import annotations

import os

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink.dialects.v20 import common as mavlink

__all__ = ["mavlink"]
