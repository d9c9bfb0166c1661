"""Settings of a live configuration that have the value that comes with grd, and depend on the vehicle.

Source: ours; the values marked SET in configs/field.yaml.
"""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Address
from typing import Any

from flow.config.yaml_text import yaml_values
from flow.graph import Graph
from flow.link import Source, Tap
from links.camera import Camera
from links.runs.shipped import CONFIGS
from links.vehicle_odometry import VehicleOdometry

EXAMPLE_RIG = "standard.yaml"
UNSTABLE = ("/dev/ttyUSB", "/dev/ttyACM", "/dev/video")  # numbered in the order of plugging in


def shipped_values(graph: Graph) -> list[str]:
    """A text for each such setting, with what to do; none for a configuration that starts its own simulated rig."""
    taps = [spec.cls.__name__ for spec in graph.nodes.values() if issubclass(spec.cls, Tap)]
    if "LiveRig" in taps or "Recorder" not in taps:
        return []
    texts = list(_rig(graph.values.get("rig")))
    for name, spec in graph.nodes.items():
        node = spec.build()
        if isinstance(node, VehicleOdometry) and node.settings.port is not None and node.settings.reference is None:
            texts.append(
                f"rig.odometry is not set: the poses of `{name}` count as those of the vehicle's camera. "
                "Set T_vehicle_reference to the pose of their reference point (base_link, INS), or `odometry: {}` if "
                "they are; 1.4 m that are not stated are an error of 2.8 m after a U-turn"
            )
        if isinstance(node, Source):
            texts += [f"{name}.{text}" for text in _source(node, spec.config)]
    return texts


def _rig(rig: Any) -> Iterator[str]:
    example = yaml_values((CONFIGS / "rigs" / EXAMPLE_RIG).read_bytes())["rig"]
    if not isinstance(rig, dict):
        return
    if rig.get("lidar") == example["lidar"]:
        yield f"rig.lidar is that of the example rig ({EXAMPLE_RIG}): calibrate yours with `grd calibrate`"
    cameras, known = rig.get("cameras"), example.get("cameras", {})
    for name, camera in cameras.items() if isinstance(cameras, dict) else ():
        if isinstance(camera, dict) and camera.get("lens") == known.get(name, {}).get("lens"):
            yield f"rig.cameras.{name}.lens is that of the example rig ({EXAMPLE_RIG}): import yours with `grd lens`"
        for key, value in known.get(name, {}).items() if isinstance(camera, dict) else ():
            if key.startswith("T_") and camera.get(key) == value:
                yield (
                    f"rig.cameras.{name}.{key} is that of the example rig ({EXAMPLE_RIG}): measure yours; a yaw error "
                    "of it is one of the drone's yaw"
                )


def _source(source: Source, config: dict[str, Any]) -> Iterator[str]:
    settings: Any = source.settings
    bind = getattr(settings, "bind", None)
    if isinstance(bind, IPv4Address) and bind.is_loopback and "port" in config:
        yield f"bind is {bind}: only this host can send to it; set this host's address on the sensor's network"
    connection = getattr(settings, "connection", None)
    if isinstance(connection, str) and "127.0.0.1" in connection:
        yield f"connection is {connection}: only a program on this host can be reached"
    for setting in ("port", "source"):
        if str(config.get(setting, "")).startswith(UNSTABLE):
            yield f"{setting} is {config[setting]}, which changes with the order of plugging in: use /dev/*/by-id/..."
    if isinstance(source, Camera) and settings.source is not None and settings.latency_s == 0:
        yield "latency_s is 0: measure it (configs/field.yaml shows how); 80 ms cost 0.18 m and 1 deg"
