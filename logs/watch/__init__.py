"""Watch a running system: in Foxglove or on a web page."""
