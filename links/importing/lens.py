"""`grd lens`: converts a camera lens from a calibration program's file to a rig file.

Source: DESIGN, Command line; the programs' formats are in `stages/lens_files`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import yaml

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.link import LinkError
from links.cli.console import check_output, out, report_errors
from links.cli.files import Overwrite
from links.recording.writer import beside
from stages.geometry.lens_files import CalibratedLens, LensFileError, lens_from_kalibr, lens_from_ocamcalib
from stages.messages import CameraMount

MAX_BYTES = 1_000_000


@report_errors
def import_lens(
    file: Annotated[Path, typer.Argument(help="Kalibr's camchain.yaml, or OCamCalib's calib_results.txt.")],
    camera_mount: Annotated[CameraMount, typer.Argument(help="Which camera of the rig it is.")],
    out_file: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Rig file to write [default: FILE with .vehicle.rig.yaml or .drone.rig.yaml]."
        ),
    ] = None,
    camera: Annotated[str, typer.Option("--camera", help="Its name in Kalibr's file.")] = "cam0",
    max_off_axis_deg: Annotated[
        float | None,
        typer.Option(
            "--max-off-axis-deg",
            min=1,
            max=150,
            help="How far off axis the calibration holds [default: Kalibr 85 (its points are < 90), OCamCalib 100].",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the lens in FILE as a rig file, to include in a configuration after its rig.

    The rig file contains the lens parameters; FILE is not needed afterwards. The other camera settings of the rig stay:
    set `masked_px` and `max_off_axis_deg` for images of this lens.

    Example: grd lens camchain.yaml vehicle --camera cam0 -o configs/rigs/vehicle_lens.yaml
    """
    target = out_file or beside(file, f".{camera_mount.value}.rig.yaml")
    if target.suffix not in (".yaml", ".yml"):
        raise LinkError(f"{target}: a rig file ends in .yaml")
    check_output(target, "--out", overwrite=overwrite and target.resolve() != file.resolve())
    found = read_lens(file, camera, max_off_axis_deg)
    target.write_text(lens_text(found, camera_mount, file.name), encoding="utf-8")
    lens, size_px = found
    size = f"{size_px[0]} x {size_px[1]} px" if size_px else "the file does not state the image size"
    out.print(f"lens        {lens.model}, up to {lens.max_off_axis_deg:g} deg off axis, {size}", markup=False)
    out.print(
        f"rig         {target}   (to fly: include it after the rig; or grd replay --overlay {target})", markup=False
    )
    out.print(
        f"check       cameras.{camera_mount.value}.T_{camera_mount.value}_camera (axes: x right, y down, z along the "
        "view), .masked_px, .max_off_axis_deg and .readout_ms (rolling shutter) are still those of the rig below it",
        soft_wrap=True,
    )


def read_lens(file: Path, camera: str, max_off_axis_deg: float | None) -> CalibratedLens:
    """The lens in a calibration program's file. LinkError names the file and the line."""
    with file.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    limit = {} if max_off_axis_deg is None else {"max_off_axis_deg": max_off_axis_deg}
    try:
        if len(data) > MAX_BYTES:
            raise LensFileError(f"larger than {MAX_BYTES} bytes: that is no calibration")
        if file.suffix in (".yaml", ".yml"):
            yaml_values(data)  # bounds what `lens_from_kalibr` expands
            return lens_from_kalibr(data.decode("utf-8"), camera, **limit)
        if file.suffix == ".txt":
            return lens_from_ocamcalib(data.decode("utf-8"), **limit)
        raise LensFileError("neither Kalibr's .yaml nor OCamCalib's .txt")
    except UnicodeDecodeError as error:
        raise LinkError(f"{file}: is not UTF-8 text (byte {error.start})") from None
    except (LensFileError, YamlTextError) as error:
        raise LinkError(f"{file}:{error.line}: {error}" if error.line else f"{file}: {error}") from None


def lens_text(found: CalibratedLens, camera_mount: CameraMount, source: str) -> str:
    """The rig file. A size that is not known is null: it hides that of the rig below."""
    width, height = found.size_px or (None, None)
    camera = {
        "size_px": width if width == height else [width, height],
        "lens": found.lens.model_dump(mode="json"),
    }
    head = [
        f"# The lens of the {camera_mount.value}'s camera, by `grd lens {source} {camera_mount.value}`.",
        "# To fly: include it after the rig; to replay with it: grd replay RECORDING --overlay THIS_FILE.",
    ]
    tree = {"rig": {"cameras": {camera_mount.value: camera}}}
    return "\n".join([*head, yaml.safe_dump(tree, sort_keys=False, width=120)])
