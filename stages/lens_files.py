"""Lenses as calibration programs write them: Kalibr's camchain YAML, OCamCalib's calib_results.txt.

Source: Kalibr, YAML formats (camchain.yaml); Scaramuzza, OCamCalib toolbox, calib_results.txt.
"""

from __future__ import annotations

from typing import Any, cast

import yaml

from stages.lens import KannalaBrandt, OCam


def lens_from_kalibr(text: str, camera: str = "cam0", max_off_axis_deg: float = 117.5) -> KannalaBrandt:
    """A camera of a Kalibr camchain YAML: `camera_model: pinhole` with `distortion_model: equidistant`.

    Kalibr has no field of view of its own: say how far off axis the calibration may be trusted.
    """
    try:
        tree: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"this is no YAML: {error}") from None
    cameras = cast("dict[str, Any]", tree) if isinstance(tree, dict) else {}
    found = cameras.get(camera)
    if not isinstance(found, dict):
        raise ValueError(f"no camera {camera!r} in this Kalibr file; it has: {', '.join(map(str, cameras)) or 'none'}")
    chain = cast("dict[str, Any]", found)
    models = (chain.get("camera_model"), chain.get("distortion_model"))
    if models != ("pinhole", "equidistant"):
        raise ValueError(
            f"{camera}: camera_model {models[0]!r} with distortion_model {models[1]!r} is not read here; "
            "calibrate with `--models pinhole-equi`, or use OCamCalib"
        )
    intrinsics, k = chain.get("intrinsics"), chain.get("distortion_coeffs")
    if not _numbers(intrinsics, 4) or not _numbers(k, 4):
        raise ValueError(f"{camera}: intrinsics and distortion_coeffs must be four numbers each")
    fu, fv, pu, pv = (float(v) for v in cast("list[float]", intrinsics))
    k1, k2, k3, k4 = (float(v) for v in cast("list[float]", k))
    return KannalaBrandt(focal_px=(fu, fv), centre_px=(pu, pv), k=(k1, k2, k3, k4), max_off_axis_deg=max_off_axis_deg)


def lens_from_ocamcalib(text: str, max_off_axis_deg: float = 100.0) -> OCam:
    """A lens from OCamCalib's calib_results.txt: lines starting with # and empty lines are skipped."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    try:
        rows = [[float(word) for word in line] for line in lines]
        direct, _, (row, column), affine, (_, _) = rows
        count = int(direct[0])
        c, d, e = affine
    except ValueError as error:
        raise ValueError(
            "this is no OCamCalib file (direct and inverse polynomial, centre, affine c d e, image size "
            f"on one line each): {error}"
        ) from None
    if count != len(direct) - 1:
        raise ValueError(f"the direct polynomial announces {count} coefficients and has {len(direct) - 1}")
    return OCam(
        polynomial=tuple(direct[1:]), centre_px=(column, row), affine_cde=(c, d, e), max_off_axis_deg=max_off_axis_deg
    )


def _numbers(value: object, count: int) -> bool:
    if not isinstance(value, list):
        return False
    items = cast("list[object]", value)
    return len(items) == count and all(isinstance(v, int | float) for v in items)
