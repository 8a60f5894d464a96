"""The shared vocabulary of all processes: robots, shapes, messages, topics and the bus that carries them."""
