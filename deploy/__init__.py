"""Put the parts together: commands, runs, data sets and experiments."""
