"""A motor of a robot in MuJoCo that can lose part of its force."""

from __future__ import annotations

import mujoco


class WeakMotor:
    """One actuator of a compiled model."""

    def __init__(self, model: mujoco.MjModel, actuator: int) -> None:
        parts = (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange)
        self._parts = [(part[actuator], part[actuator].copy()) for part in parts]  # views, and what a whole motor has

    def set(self, share: float) -> None:
        """Leave the motor this share of its force and of its gains; 1 restores it.

        Raises:
            ValueError: the share is not above 0 and at most 1.
        """
        if not 0.0 < share <= 1.0:
            raise ValueError(f"weak_motor is above 0 and at most 1, not {share:g}")
        for part, whole in self._parts:
            part[:] = share * whole
