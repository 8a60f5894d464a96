"""The methods that ours is compared with, behind the same interface."""
