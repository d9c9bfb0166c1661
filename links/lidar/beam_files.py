"""Reads the LiDAR of a rig file, and the beams of a unit from its manufacturer's file.

Source: Ouster firmware manual, sensor metadata; Hesai XT user manuals, angle correction file.
"""

from __future__ import annotations

import csv
import json
from io import StringIO
from typing import Any

from pydantic import ValidationError

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.link import LinkError
from stages.geometry.lidar_models import LIDAR_MODELS, LidarModel
from stages.geometry.rig_lidar import LidarBeams, RigLidar


def ouster_beams(text: str, source: str) -> tuple[LidarModel, LidarBeams]:
    """Model and beams from an Ouster's metadata (JSON, as the sensor or its tools write it). LinkError: it is none."""
    try:
        tree: dict[str, Any] = json.loads(text)
        if not isinstance(tree, dict):
            raise TypeError("it is no JSON object")
        flat = {**tree, **{k: v for part in tree.values() if isinstance(part, dict) for k, v in part.items()}}
        lasers = len(flat["beam_altitude_angles"])
        model: Any = f"{flat['prod_line'].replace('OS-', 'OS')[:3]}-{lasers}"
        if model not in LIDAR_MODELS:
            raise LinkError(f"{source}: metadata of an Ouster {flat['prod_line']}; supported are OS0 and OS1")
        columns, spin_hz = (int(part) for part in flat["lidar_mode"].split("x"))
        transform = flat.get("beam_to_lidar_transform")
        beams = LidarBeams(
            elevation_deg=tuple(flat["beam_altitude_angles"]),
            azimuth_deg=tuple(flat["beam_azimuth_angles"]),
            origin_mm=transform[3] if transform else flat.get("lidar_origin_to_beam_origin_mm", 0.0),
            columns=columns,  # pyright: ignore[reportArgumentType]
            spin_hz=spin_hz,  # pyright: ignore[reportArgumentType]
            columns_per_packet=flat["columns_per_packet"],
            packets=flat.get("udp_profile_lidar", "LEGACY"),
            serial=int(flat["prod_sn"]),
        )
    except KeyError as error:
        raise LinkError(f"{source}: not the metadata of an Ouster sensor: it has no {error}") from None
    except (TypeError, AttributeError, ValueError) as error:
        raise LinkError(f"{source}: not the metadata of an Ouster sensor: {_reason(error)}") from None
    return model, beams


def hesai_beams(text: str, source: str) -> tuple[LidarModel, LidarBeams]:
    """Model and beams from a Hesai XT's angle correction file (CSV: channel, elevation, azimuth).

    LinkError: it is none.
    """
    try:
        rows = sorted(
            (int(row[0]), float(row[1]), float(row[2])) for row in list(csv.reader(StringIO(text)))[1:] if row
        )
        if [channel for channel, _, _ in rows] != list(range(1, len(rows) + 1)):
            raise ValueError("its channels are not 1, 2, 3, ...")
        model: Any = f"XT{len(rows)}"
        if model not in LIDAR_MODELS:
            raise ValueError(f"it has {len(rows)} channels; supported are XT16 and XT32")
        return model, LidarBeams(elevation_deg=tuple(w for _, w, _ in rows), azimuth_deg=tuple(a for _, _, a in rows))
    except (ValueError, IndexError) as error:
        raise LinkError(f"{source}: not the angle correction file of a Hesai XT: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """The first error in one line."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return ".".join(map(str, first["loc"])) + f": {first['msg'].removeprefix('Value error, ')}"
    return str(error).splitlines()[0]


def rig_unit(rig_yaml: str, source: str) -> RigLidar:
    """The LiDAR of a rig file's text. Raises LinkError with the reason."""
    try:
        return RigLidar.model_validate(yaml_values(rig_yaml)["lidar"])
    except (YamlTextError, KeyError, TypeError) as error:
        raise LinkError(f"{source}: the rig cannot be read: {str(error).splitlines()[0]}") from None
    except ValidationError as errors:
        raise LinkError(f"{source}: the rig's lidar.{_reason(errors)}") from None
