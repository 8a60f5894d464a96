"""Compiled loops of perception. `tests/safety/perception_twins.py` has a plain NumPy twin of each."""
