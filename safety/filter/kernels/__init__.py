"""Compiled loops of the filter; each has a plain NumPy twin in the tests."""
