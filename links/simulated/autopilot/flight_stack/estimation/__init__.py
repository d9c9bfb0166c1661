"""EKF cores of the simulated autopilot: EKF3 of ArduPilot and EKF2 of PX4, their sources and rules."""
