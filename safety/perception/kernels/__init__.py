"""Compiled loops of perception; each has a plain NumPy twin in the tests."""
