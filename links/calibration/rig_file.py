"""The calibrated rig as a file, for `--overlay`, for `include:` in a configuration, or for `--rig`.

Source: ours; the format of configs/rigs/standard.yaml.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import yaml

from stages.calibration.calibrate import Calibration
from stages.calibration.result import Finding
from stages.geometry.frames import LidarMount, Pose

DIGITS = 7
ZERO_NOTE = (
    "# A zero that differs from that removes the mean of the encoder's error, which is indistinguishable from a zero."
)


def rig_text(rig: dict[str, Any], found: Calibration, source: str) -> str:
    """The whole rig file: the old rig with the calibrated LiDAR mount, and a comment line for each parameter."""
    new = copy.deepcopy(rig)
    new["lidar"]["mount"] = mount_tree(found.mount)
    head = [
        f"# Found by `grd calibrate {source}`; everything but lidar.mount is as it was.",
        "# To replay with it: grd replay RECORDING --overlay THIS_FILE; to fly: include it in place of the rig's file.",
        *(f"# {describe(finding)}" for finding in found.findings),
        *(() if zero_found(found) else (ZERO_NOTE,)),
    ]
    return "\n".join([*head, yaml.safe_dump({"rig": new}, sort_keys=False, width=120)])


def zero_found(found: Calibration) -> bool:
    """Whether the servo's zero was estimated, from a wall."""
    return not next(finding.rejected for finding in found.findings if finding.name == "zero")


def mount_tree(mount: LidarMount) -> dict[str, Any]:
    """A mount as YAML values with every key, so that as an overlay it replaces another mount completely."""
    return {
        "T_vehicle_turntable": pose_tree(mount.T_vehicle_turntable),
        "T_turntable_lidar": pose_tree(mount.T_turntable_lidar),
        "turns": mount.turns,
        "servo_sign": mount.servo_sign,
        "servo_zero_deg": round(mount.servo_zero_deg, DIGITS),
        "servo_time_offset_s": round(mount.servo_time_offset_s, DIGITS),
        "servo_harmonics": [
            {
                "order": term.order,
                "amplitude_deg": round(term.amplitude_deg, DIGITS),
                "phase_deg": round(term.phase_deg, DIGITS),
            }
            for term in mount.servo_harmonics
        ],
        "servo_play_deg": round(mount.servo_play_deg, DIGITS),
        "pointing_sigma_deg": round(mount.pointing_sigma_deg, 3),
    }


def pose_tree(pose: Pose) -> dict[str, Any]:
    """A pose as YAML values; the rotation format that is not used is null."""
    return {
        "xyz_m": [round(value, DIGITS) for value in pose.xyz_m],
        "rpy_deg": None if pose.rpy_deg is None else list(pose.rpy_deg),
        "quaternion_xyzw": None if pose.quaternion_xyzw is None else [round(q, 9) for q in pose.quaternion_xyzw],
    }


def describe(finding: Finding) -> str:
    """A finding in one line."""
    if finding.rejected:
        return f"{finding.what}: stays {finding.before:.4g} {finding.unit}: {finding.rejected}"
    digits = max(0, 1 - math.floor(math.log10(max(finding.sigma, 1e-9))))
    return (
        f"{finding.what}: {finding.after:.{digits}f} +- {finding.sigma:.{digits}f} {finding.unit} "
        f"(was {finding.before:.{digits}f})"
    )
