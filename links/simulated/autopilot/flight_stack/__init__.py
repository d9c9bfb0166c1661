"""An autopilot in the loop: airframe, sensors, EKF, source sets, guidance, failsafes and telemetry."""
