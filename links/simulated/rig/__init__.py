"""A simulated rig: scenario, simulation run, closed loop, real-time rig, ground truth records."""
