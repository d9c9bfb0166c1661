"""The ground vehicle's own body: what shadows the lower half of the LiDAR's view.

Source: ours, a compact estate car. Frame: vehicle (origin at the roof camera, x forward, y left, z up).
"""

from __future__ import annotations

from links.simulated.mesh import Mesh, box, merge, rod

ROOF_BELOW_CAMERA_M = 0.15


def vehicle_mesh(camera_height_m: float) -> Mesh:
    """Car body, roof rack and the turntable's mast; the road is `camera_height_m` below the camera."""
    roof, road = -ROOF_BELOW_CAMERA_M, -camera_height_m
    belt = road + 0.9
    return merge(
        [
            box((-2.3, -0.9, road + 0.25), (2.1, 0.9, belt), "paint_light"),
            box((-2.2, -0.85, belt), (0.9, 0.85, roof), "paint_light", taper=0.15),
            box((-0.3, -0.4, roof), (0.3, 0.4, roof + 0.03), "metal"),  # rack plate
            rod((0.0, 0.0, roof), (0.0, 0.0, 0.25), 0.03, "metal"),  # mast and servo
            box((-0.04, -0.04, -0.03), (0.04, 0.04, 0.03), "metal"),  # camera
        ]
    )
