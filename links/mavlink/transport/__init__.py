"""Transport of MAVLink frames: framing, signing, and UDP, TCP and serial connections to an autopilot."""
