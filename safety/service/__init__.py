"""The safety service as a process, and every way to ask the filter."""
