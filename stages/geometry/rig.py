"""The rig: what the `rig:` section of a configuration, a rig file, and the rig attached to a recording may contain.

Settings refer to its values one by one (`$rig.drone.span_m`), each stage to those that it needs; `Rig` is the whole.

Source: ours; the format of configs/rigs/standard.yaml.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Pose
from stages.geometry.lens import Lens, Polygon
from stages.geometry.rig_lidar import RigLidar
from stages.messages import CameraMount

_Pixels = Annotated[int, Field(ge=1)]
SizePx = _Pixels | tuple[_Pixels, _Pixels]
"""Size of a camera's images: the side of square ones, or (width, height)."""


def width_height_px(size: SizePx) -> tuple[int, int]:
    """(width, height) of images."""
    return (size, size) if isinstance(size, int) else size


class RigDrone(StrictModel):
    """`rig.drone`."""

    span_m: float = Field(0.5, gt=0, le=10)  # largest dimension


class _Camera(StrictModel):
    """What both cameras have; each also has `pose()`, T_mount_camera."""

    lens: Lens
    size_px: SizePx | None = None  # of the calibration images; None: not known, and the images are not checked
    max_off_axis_deg: float | None = Field(None, gt=0, le=150)  # rays farther off axis are not used; None: lens's limit
    masked_px: tuple[Polygon, ...] = ()  # over the body of the vehicle or drone
    readout_ms: float = Field(0.0, ge=0, le=100)  # from the first row's exposure to the last's: a rolling shutter


class VehicleCamera(_Camera):
    """`rig.cameras.vehicle`."""

    T_vehicle_camera: Pose

    def pose(self) -> Pose:
        """T_mount_camera."""
        return self.T_vehicle_camera


class DroneCamera(_Camera):
    """`rig.cameras.drone`."""

    T_drone_camera: Pose

    def pose(self) -> Pose:
        """T_mount_camera."""
        return self.T_drone_camera


class RigCameras(StrictModel):
    """`rig.cameras`."""

    vehicle: VehicleCamera | None = None
    drone: DroneCamera | None = None

    def of(self, camera_mount: CameraMount) -> VehicleCamera | DroneCamera | None:
        """The camera on a mount, None without one."""
        return self.vehicle if camera_mount is CameraMount.VEHICLE else self.drone

    def frame_ids(self) -> list[str]:
        """Frame ids of the images of the configured cameras."""
        return [f"camera_{camera_mount.value}" for camera_mount in CameraMount if self.of(camera_mount) is not None]


class RigOdometry(StrictModel):
    """`rig.odometry`: what the poses of the vehicle's odometry are poses of."""

    T_vehicle_reference: Pose = Pose()  # its reference point (base_link, INS), with axes x forward, y left, z up
    axes: Literal["flu", "frd"] = "flu"  # of its poses and their frame: z up; frd: z down, as in NED


class Rig(StrictModel):
    """The whole rig."""

    version: Literal[1] = 1  # of this format
    lidar: RigLidar | None = None
    drone: RigDrone | None = None
    cameras: RigCameras | None = None
    odometry: RigOdometry | None = None  # None: its poses are those of frame vehicle
