"""The commands of `brakeline.deploy.cli`, a dataclass each: its fields are the options, `run` does the work."""
