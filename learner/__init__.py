"""The process that learns from all robots' steps and publishes weights."""
