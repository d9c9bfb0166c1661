"""Perturbations of a rig: how it differs from its rig file, and which drone flies, drawn per flight.

| quantity | one sigma | reason |
| --- | --- | --- |
| servo zero against the vehicle axes | 0.1 deg | not observable by `grd calibrate`: 2 mm in a metre |
| tilt of the turntable, per axis | 0.05 deg | the same, against the level of the vehicle camera |
| range of the LiDAR, common to all lasers | 0.017 m | VLP-16 data sheet 63-9229: +-3 cm, taken as uniform |
| mount of a camera, per axis | 0.05 deg | repeatability of Kalibr between calibrations |
| its focal length; its centre, per axis | 0.05 %; 0.15 px at 720 px | the same: some tenths of a pixel at the rim |

The drone has any of the shapes, in its nominal size, and any surface. Its span is known, as if measured.

Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from links.simulated.sensors.camera import CameraMiscalibration, rotated
from links.simulated.world.drone import SPAN_M, DroneModel, Shape, Surface
from stages.geometry.frames import LidarMount

ZERO_DEG, TILT_DEG = 0.1, 0.05
RANGE_M = 0.017
CAMERA_DEG, FOCAL_SHARE, CENTRE_SHARE = 0.05, 5e-4, 2e-4  # fractions of the focal length and of the image size


@dataclass(frozen=True)
class PerturbedRig:
    """Perturbations of one rig, and its drone."""

    zero_deg: float
    tilt_deg: tuple[float, float]
    range_offset_m: float
    camera_vehicle: CameraMiscalibration
    camera_drone: CameraMiscalibration
    model: DroneModel

    @property
    def span_m(self) -> float:
        """The drone's."""
        return SPAN_M[self.model.shape]

    def mount(self, stated: LidarMount) -> LidarMount:
        """The true mount of the LiDAR, given the one in the rig file."""
        turntable = rotated(stated.T_vehicle_turntable, (*self.tilt_deg, 0.0))
        zero_deg = stated.servo_zero_deg + self.zero_deg
        return stated.model_copy(update={"T_vehicle_turntable": turntable, "servo_zero_deg": zero_deg})


def draw_perturbed_rig(flight: str, seed: int) -> PerturbedRig:
    """The perturbed rig and the drone of a flight."""
    rng = np.random.default_rng([seed, 50, *flight.encode()])
    tilt = rng.normal(0.0, TILT_DEG, 2).tolist()
    return PerturbedRig(
        zero_deg=float(rng.normal(0.0, ZERO_DEG)),
        tilt_deg=(tilt[0], tilt[1]),
        range_offset_m=float(rng.normal(0.0, RANGE_M)),
        camera_vehicle=_camera_error(rng),
        camera_drone=_camera_error(rng),
        model=DroneModel(
            shape=get_args(Shape)[rng.integers(len(get_args(Shape)))],
            surface=get_args(Surface)[rng.integers(len(get_args(Surface)))],
        ),
    )


def _camera_error(rng: np.random.Generator) -> CameraMiscalibration:
    turn, centre = rng.normal(0.0, CAMERA_DEG, 3).tolist(), rng.normal(0.0, CENTRE_SHARE, 2).tolist()
    return CameraMiscalibration(
        rotation_deg=(turn[0], turn[1], turn[2]),
        focal_share=float(rng.normal(0.0, FOCAL_SHARE)),
        centre_share=(centre[0], centre[1]),
    )
