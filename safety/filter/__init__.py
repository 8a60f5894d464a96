"""From a proposed action to a verified plan."""
