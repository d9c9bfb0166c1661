"""The simulated autopilot: its MAVLink messages, its radio link, and its use of external poses."""
