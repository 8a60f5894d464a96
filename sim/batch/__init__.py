"""The environment of many robots at once, as arrays."""
