"""Every exception of Brakeline, in one tree. `except BrakelineError` catches what the package raises on purpose."""

from __future__ import annotations


class BrakelineError(Exception):
    """The base of every exception that Brakeline raises on purpose."""


class MissingExtra(BrakelineError, ImportError):
    """An optional package is not installed. The message names the extra that brings it."""
