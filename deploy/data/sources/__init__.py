"""Readers of recordings, one a format: each gives tables (`table.py`) with the names of `quantities.py`."""
