"""From recorded data to a model set: what a robot may do next, and how sure that is."""
