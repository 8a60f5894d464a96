"""pymavlink's dialect `ardupilotmega` (`common` and ArduPilot's messages) as MAVLink 2; import it only from here."""

from __future__ import annotations

import os

os.environ.setdefault("MAVLINK20", "1")  # pymavlink reads it when it is imported

from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["mavlink"]
