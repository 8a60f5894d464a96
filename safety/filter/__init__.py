"""Decide on proposed actions: tube, half-spaces, QP, backup plan and recovery."""
