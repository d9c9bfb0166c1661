"""The simulated autopilot: its MAVLink messages, its radio link, and how it treats external poses."""
