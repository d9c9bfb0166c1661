"""The operator's page names what grd may say, so that nobody meets a word in the field that it does not explain."""

from __future__ import annotations

import configparser
from pathlib import Path

import pytest

from links.dynamixel.wire import Health
from links.mavlink.gate import Refusal as GateRefusal
from links.recording.writer import CLOSE_TIMEOUT_S
from links.velodyne.position import Pps
from links.velodyne.refusal import Refusal
from stages.messages import BranchState, PoseState, TrackingState

PAGE = " ".join((Path(__file__).parents[1] / "deploy" / "OPERATOR.md").read_text(encoding="utf-8").split())
WORDS = {
    "states": [state.name for kind in (PoseState, TrackingState, BranchState, Pps) for state in kind],
    "why no pose goes out": [f"`{why.value}`" for why in GateRefusal],
    "why a packet is ignored": [why.value.partition(" (")[0] for why in Refusal],
    "the servo's counters": [f"`{name}`" for name in Health._fields],
}


@pytest.mark.parametrize("kind", WORDS)
def test_the_operators_page_explains(kind: str) -> None:
    assert [word for word in WORDS[kind] if word not in PAGE] == []


def test_the_unit_ends_grd_in_order_and_starts_it_again() -> None:
    unit = configparser.RawConfigParser(strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(Path(__file__).parents[1] / "deploy" / "grd.service", encoding="utf-8")
    service = unit["Service"]
    assert (service["KillSignal"], service["KillMode"], service["Restart"]) == ("SIGTERM", "mixed", "on-failure")
    assert float(service["TimeoutStopSec"]) > CLOSE_TIMEOUT_S, "the recorder may take so long to write what waits"
    assert set(unit["Unit"]["Wants"].split()) == set(unit["Unit"]["After"].split())
    for command in (service["ExecStart"], service["ExecStartPre"]):
        assert "configs/field.yaml --overlay /etc/grd/vehicle.yaml" in command
