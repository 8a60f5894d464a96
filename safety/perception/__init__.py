"""Free space from what a sensor measures."""
