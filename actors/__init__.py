"""Processes that drive robots: they observe, propose, ask the safety service, act and publish."""
