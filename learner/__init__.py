"""The learner: the process that learns from the steps of all actors and publishes weights."""
