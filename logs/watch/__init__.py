"""A running system, live: in Foxglove, and without it on a web page of its own."""
