"""A graph that closes the loop and sweeps in 0.75 s."""

GRAPH = """\
stages:
  aim:
    use: stages.aim.SweepVibrateAim
    config: {mount: $rig.lidar.mount, sweep_rpm: 40}
    inputs:
      {servo: servo.servo_state, state: track.track_state, fix: track.drone_fix, detections: detect.detections}
  sweep:
    use: stages.sweep.Sweep
    config: {mount: $rig.lidar.mount, image_size_px: 256}
    inputs: {firings: lidar.lidar_firings, servo: servo.servo_state}
  detect: {use: stages.detect.KernelDetect, inputs: {image: sweep.depth_image}}
  track:
    use: stages.track.MeanShiftTrack
    inputs: {points: sweep.swept_points, detections: detect.detections}
links:
  lidar: {use: links.lidar.Lidar}
  servo: {use: links.dynamixel.Servo, inputs: {goal: aim.servo_goal}}
"""
