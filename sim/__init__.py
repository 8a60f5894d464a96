"""Simulation: arenas, sensors, robots and the Gymnasium environment. It does not use the bus."""
