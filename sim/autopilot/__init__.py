"""The quadrotor's autopilot: a MAVLink 2 endpoint over a simulated vehicle. pymavlink stays inside this package."""
