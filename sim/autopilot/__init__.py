"""The quadrotor's autopilot: a MAVLink 2 endpoint for a simulated vehicle. Only this part of `sim` uses pymavlink."""
