"""From a source of data to a model set."""
