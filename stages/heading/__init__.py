"""Which way round: quarter turns, or any heading, weighed by the drone's way told twice, by LiDAR and by odometry.

Both `align`, which gives a rotation out, and `fuse`, which looks at it a second time, ask here.
"""
