"""Messages that the autopilot sends: which are requested at which rates, and the times of its IMU messages."""
