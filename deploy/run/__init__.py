"""How a run on this machine is started, watched, looked at again."""
