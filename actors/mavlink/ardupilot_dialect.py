"""pymavlink's `ardupilotmega` dialect (`common`, and what ArduPilot adds) as MAVLink 2; nothing else imports it."""

from __future__ import annotations

import os

os.environ.setdefault("MAVLINK20", "1")  # read when pymavlink is imported

from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["mavlink"]
