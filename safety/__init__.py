"""The safety filter: from recorded data to a decision on each proposed input."""
