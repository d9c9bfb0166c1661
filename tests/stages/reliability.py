"""Errors and stated sigmas of vanishing directions on simulated and real images.

Real: renders of panoramas (tests/stages/panoramas.py), the training half of York Urban, the corridor fisheye.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from stages.geometry.frames import Pose
from stages.messages import CameraMount
from stages.vp import GreatCircleVp, PaperVp
from tests.stages.panoramas import DirectionErrors, direction_errors
from tests.stages.simulated_views import View, views

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
_ON_AXIS = ((0, 0), (-90, 70), (0, 70))
_LEVEL = ((-90, 70), (30, 70), (150, 70))
PAPER = {
    f"paper, {vote}, {name}": {
        "vote": vote,
        "views": [{"azimuth_deg": azimuth, "off_axis_deg": off} for azimuth, off in layout],
    }
    for vote in ("image", "sphere")
    for name, layout in (("one view on the axis", _ON_AXIS), ("three at 70 deg", _LEVEL))
}


def of_views(scene: str, seeds: Iterable[int], count: int, clutter: bool) -> dict[str, list[DirectionErrors]]:
    """Errors of grd and of the paper's variants to `count` images of each camera of each world."""
    found: dict[str, list[DirectionErrors]] = {name: [] for name in ("grd", *PAPER)}
    for seed in seeds:
        stages: dict[CameraMount, dict[str, GreatCircleVp | PaperVp]] = {}
        for view in views(scene, seed, count, clutter):
            if view.camera_mount not in stages:
                stages[view.camera_mount] = _stages(view)
            for name, stage in stages[view.camera_mount].items():
                if isinstance(stage, GreatCircleVp) and view.tilt is not None:
                    stage.on_tilt(view.tilt)
                found[name].append(direction_errors(stage.on_image(view.image), view.R_world_mount, view.truth))
    return found


def _rig(view: View) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings that all stages share, and the camera as the rig file states it."""
    name = view.camera_mount.value
    rig = yaml.safe_load(view.scenario.rig_yaml())["cameras"][name]
    mount = Pose.model_validate(rig[f"T_{name}_camera"])
    return {"camera_mount": view.camera_mount, "T_mount_camera": mount, "lens": rig["lens"]}, rig


def grd_stage(view: View) -> GreatCircleVp:
    """grd's stage for the camera of a view."""
    common, rig = _rig(view)
    return GreatCircleVp(**common, masked_px=rig["masked_px"], max_off_axis_deg=rig["max_off_axis_deg"])


def _stages(view: View) -> dict[str, GreatCircleVp | PaperVp]:
    common, rig = _rig(view)
    paper = {name: PaperVp(**common, size_px=rig["size_px"], **settings) for name, settings in PAPER.items()}
    return {"grd": grd_stage(view), **paper}
