"""The safety service as a process, and its clients: over the bus and in process."""
