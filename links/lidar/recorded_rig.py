"""Settings of the LiDARs in the configuration that a recording contains.

The clock mode of the recorded run decides how its packets are stamped in a replay.
"""

from __future__ import annotations

from typing import Any, cast

from flow.config.yaml_text import YamlTextError, yaml_values

USE = "links.lidar.Lidar"


def recorded_lidars(config_yaml: str | None) -> list[dict[str, Any]]:
    """The `config` of each LiDAR node, as written; empty where the recording holds no readable configuration."""
    try:
        tree = yaml_values(config_yaml or "")
    except YamlTextError:
        return []
    links = tree.get("links") if isinstance(tree, dict) else None
    nodes = cast("dict[str, Any]", links).values() if isinstance(links, dict) else ()
    lidars = [node for node in nodes if isinstance(node, dict) and node.get("use") == USE]
    configs = [cast("dict[str, Any]", node).get("config") for node in lidars]
    return [cast("dict[str, Any]", config) if isinstance(config, dict) else {} for config in configs]
