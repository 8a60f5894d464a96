"""Compiled loops of the simulators; each has a plain twin in the tests, or MuJoCo itself."""
