"""Physics: arenas, sensors and robots. Knows nothing of the bus."""
