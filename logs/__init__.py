"""Recording, reading and analysing MCAP logs."""
