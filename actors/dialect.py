"""pymavlink's `ardupilotmega` dialect, as MAVLink 2: `common`, and what ArduPilot adds; the one place that imports it."""

from __future__ import annotations

import os

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["mavlink"]
