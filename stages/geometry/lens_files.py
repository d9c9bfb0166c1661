"""Lenses as calibration programs write them: Kalibr's camchain YAML, OCamCalib's calib_results.txt.

Source: Kalibr, YAML formats (camchain.yaml); Scaramuzza, OCamCalib toolbox, calib_results.txt.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import yaml
from pydantic import ValidationError

from stages.geometry.lens import KannalaBrandt, OCam

OCAMCALIB_ROWS = ("direct polynomial", "inverse polynomial", "centre", "affine c d e", "image size")


class CalibratedLens(NamedTuple):
    """A lens and the size of the images that it was calibrated with."""

    lens: KannalaBrandt | OCam
    size_px: tuple[int, int] | None  # (width, height), where the file contains it


class LensFileError(ValueError):
    """Error in a calibration file, with its line; 0: the whole file."""

    def __init__(self, text: str, line: int = 0) -> None:
        super().__init__(text)
        self.line = line


def lens_from_kalibr(text: str, camera: str = "cam0", max_off_axis_deg: float = 85.0) -> CalibratedLens:
    """A camera of a Kalibr camchain YAML: `camera_model: pinhole` with `distortion_model: equidistant`.

    Kalibr states no field of view. It uses no point at 90 deg off axis or more (PinholeProjection), so that beyond the
    outermost points, some 85 deg, its polynomial is extrapolated.
    """
    try:
        tree: Any = yaml.safe_load(text)
        lines = _lines(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise LensFileError(f"this is no YAML: {error.problem}", mark.line + 1 if mark else 0) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date that is none
        raise LensFileError(f"this is no YAML: {str(error).splitlines()[0]}") from None
    cameras = cast("dict[str, Any]", tree) if isinstance(tree, dict) else {}
    found = cameras.get(camera)
    if not isinstance(found, dict):
        raise LensFileError(
            f"no camera {camera!r} in this Kalibr file; it has: {', '.join(map(str, cameras)) or 'none'}"
        )
    chain = cast("dict[str, Any]", found)

    def line(key: str) -> int:
        return lines.get((camera, key), lines.get((camera, ""), 0))

    models = (chain.get("camera_model"), chain.get("distortion_model"))
    if models != ("pinhole", "equidistant"):
        wrong = "camera_model" if models[0] != "pinhole" else "distortion_model"
        raise LensFileError(
            f"{camera}: camera_model {models[0]!r} with distortion_model {models[1]!r} is not read here; "
            "calibrate with OCamCalib, or, up to 85 deg off axis, with `--models pinhole-equi`",
            line(wrong),
        )
    for key in ("intrinsics", "distortion_coeffs"):
        if not _numbers(chain.get(key), 4):
            raise LensFileError(f"{camera}: intrinsics and distortion_coeffs must be four numbers each", line(key))
    fu, fv, pu, pv = (float(v) for v in chain["intrinsics"])
    k1, k2, k3, k4 = (float(v) for v in chain["distortion_coeffs"])
    size: Any = chain.get("resolution")
    if size is not None and not (_numbers(size, 2) and all(v == int(v) > 0 for v in size)):
        raise LensFileError(f"{camera}: resolution must be width and height in pixels", line("resolution"))
    try:
        lens = KannalaBrandt(
            focal_px=(fu, fv), centre_px=(pu, pv), k=(k1, k2, k3, k4), max_off_axis_deg=max_off_axis_deg
        )
    except ValidationError as errors:
        raise LensFileError(f"{camera}: {_first_errors(errors)}", line("distortion_coeffs")) from None
    return CalibratedLens(lens, None if size is None else (int(size[0]), int(size[1])))


def lens_from_ocamcalib(text: str, max_off_axis_deg: float = 100.0) -> CalibratedLens:
    """A lens from OCamCalib's calib_results.txt: lines starting with # and empty lines are skipped."""
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, words in enumerate(text.splitlines(), 1):
        if not words.strip() or words.lstrip().startswith("#"):
            continue
        try:
            rows.append([float(number) for number in words.split()])
        except ValueError as error:
            raise _no_ocamcalib(str(error), number) from None
        lines.append(number)
    if len(rows) != len(OCAMCALIB_ROWS):
        raise _no_ocamcalib(f"{len(rows)} lines of numbers", lines[-1] if lines else 0)
    for row, line, what, count in zip(rows[2:], lines[2:], OCAMCALIB_ROWS[2:], (2, 3, 2), strict=True):
        if len(row) != count:
            raise _no_ocamcalib(f"{what}: {len(row)} numbers instead of {count}", line)
    direct, _, (row, column), (c, d, e), (height, width) = rows
    if direct[0] != len(direct) - 1:
        raise LensFileError(
            f"the direct polynomial announces {direct[0]:g} coefficients and has {len(direct) - 1}", lines[0]
        )
    if not all(v == v // 1 > 0 for v in (height, width)):
        raise _no_ocamcalib("image size: height and width in pixels", lines[4])
    try:
        lens = OCam(
            polynomial=tuple(direct[1:]),
            centre_px=(column, row),
            affine_cde=(c, d, e),
            max_off_axis_deg=max_off_axis_deg,
        )
    except ValidationError as errors:
        raise LensFileError(_first_errors(errors), lines[0]) from None
    return CalibratedLens(lens, (int(width), int(height)))


def _no_ocamcalib(why: str, line: int) -> LensFileError:
    return LensFileError(f"this is no OCamCalib file ({', '.join(OCAMCALIB_ROWS)} on one line each): {why}", line)


def _first_errors(errors: ValidationError) -> str:
    first = errors.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {first['msg']}" if where else first["msg"].removeprefix("Value error, ")


def _lines(text: str) -> dict[tuple[str, str], int]:
    """Line of each camera (key "") and of each of its keys."""
    root = cast(Any, yaml.compose(text, Loader=yaml.SafeLoader))  # pyright: ignore[reportUnknownMemberType]
    found: dict[tuple[str, str], int] = {}
    for camera, body in root.value if isinstance(root, yaml.MappingNode) else ():
        found[str(camera.value), ""] = camera.start_mark.line + 1
        for key, _ in body.value if isinstance(body, yaml.MappingNode) else ():
            found[str(camera.value), str(key.value)] = key.start_mark.line + 1
    return found


def _numbers(value: object, count: int) -> bool:
    if not isinstance(value, list):
        return False
    items = cast("list[object]", value)
    return len(items) == count and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in items
    )
