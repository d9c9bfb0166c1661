"""The flight of configs/scenarios/live_street.yaml, round and round for as long as it is wanted."""

from __future__ import annotations

from pathlib import Path

import yaml

SCENARIO = Path(__file__).resolve().parents[2] / "configs/scenarios/live_street.yaml"
ROUND_S = 80.0


def flown_for(seconds: float) -> str:
    """The scenario as YAML. Its first round is repeated; the yaw goes on."""
    scenario = yaml.safe_load(SCENARIO.read_text(encoding="utf-8"))
    path = scenario["drone"]["path"]
    one = [w for w in path["waypoints"] if w["t_s"] < ROUND_S]
    path["waypoints"] = [
        {**w, "t_s": w["t_s"] + k * ROUND_S, "yaw_deg": w["yaw_deg"] + 360 * k}
        for k in range(int(seconds / ROUND_S) + 1)
        for w in one
    ]
    return yaml.safe_dump({**scenario, "duration_s": seconds})
