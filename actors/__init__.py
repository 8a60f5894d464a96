"""Processes that drive robots: observe, propose, ask the safety service, act, publish."""
