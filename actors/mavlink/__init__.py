"""Vehicles behind MAVLink, seen from an actor."""
