"""Transport of MAVLink bytes: UDP, TCP and serial connections to an autopilot."""
