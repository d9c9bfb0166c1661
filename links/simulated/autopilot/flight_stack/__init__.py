"""An autopilot in the loop: airframe, sensors, EKF, source sets, guidance, failsafes, telemetry; flown by what it is sent."""
