"""deploy/OPERATOR.md explains every state, reason, counter and text of grd.

Enum values and counters are in the first column of their table. Texts are on the page and in the source that reports
them, so that neither changes alone.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

from links.dynamixel.wire import Health
from links.lidar.position import Pps
from links.lidar.reject_reason import PacketRejectReason
from links.mavlink.poses.gate import RejectReason as GateRejectReason
from links.recording import Recorder
from links.recording.writer import CLOSE_TIMEOUT_S
from stages.messages import BranchState, PoseState, TrackingState
from tests.command import unit_file
from tests.links.fault_bounds import BOUNDS, FIRST_POSE_S, FIRST_POSITION_S, KILLED, MAX_RECORDING_LOSS_S, REST_S

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "deploy" / "OPERATOR.md").read_text(encoding="utf-8")
TABLE = re.compile(r"^\| (?P<head>[^|]+?) \|.*\n\| ---.*\n(?P<rows>(?:\|.*\n)+)", re.MULTILINE)
TABLES = {
    found["head"]: [re.split(r"(?<!\\) \| ", row.strip("| ")) for row in found["rows"].splitlines()]
    for found in TABLE.finditer(PAGE)
}
VALUES = {  # table and the values in it
    "state of the pose": [state.name for state in PoseState],
    "state of the track (shown while there is no pose yet)": [state.name for state in TrackingState],
    "state of the rotation by cameras": [state.name for state in BranchState],
    "reason why no pose is sent": [reason.value for reason in GateRejectReason],
    "LiDAR": ["decoded", "lost", "from other senders", *(f"PPS {pps.name.lower()}" for pps in Pps), "PPS locks lost"],
    "LiDAR, `rejected: ` and the reason": [reason.value for reason in PacketRejectReason],
    "servo": list(Health._fields),
}
TEXTS = {  # source file and its texts
    "flow/events.py": ["more events of other kinds"],
    "flow/live/live.py": ["works again", "did not end in time"],
    "flow/live/source.py": [
        "; it is reopened",
        "records arrive again",
        "has sent nothing for",
        "its records have ended",
    ],
    "flow/live/threads.py": ["is switched off: ", "takes fewer images: this host is too slow for all stages"],
    "flow/live/wiring.py": ["cannot run live: it gives nothing"],
    "flow/live/supervised_stage.py": ["restarts", "stays off"],
    "links/runs/live_run.py": ["cannot write to the terminal"],
    "links/runs/results.py": ["results are being lost"],
    "links/recording/recorder.py": ["nothing is recorded now"],
    "links/lidar/udp.py": ["cannot listen on UDP", "is the network interface still up?", "no packet on UDP"],
    "links/lidar/lidar.py": [
        "consecutive packets are invalid",
        "these packets come from a",
        "the sensor's clock is not locked to UTC",
        "the sensor's clock lost its lock to UTC",
        "no position packet arrives on UDP",
    ],
    "links/camera/camera.py": [
        "but the lens is calibrated for",
        "this host decodes the stream more slowly than it arrives",
    ],
    "links/camera/capture.py": ["cannot be opened as a camera", "delivers no more frames", "stale", "damaged"],
    "links/camera/live_camera.py": ["overtaken", "lost", "opened again"],
    "links/dynamixel/drive.py": ["the servo is not configured for grd: "],
    "links/dynamixel/worker.py": ["does not reply at"],
    "links/dynamixel/readings.py": ["the servo process ended", "process restarts"],
    "links/dynamixel/servo.py": [
        "does not move: ",
        "it is set up again automatically",
        "the servo is stopped",
        "stops: no aim stage",
        "goals clamped to limits_deg",
        "goals clamped to speed_limit_rpm",
    ],
    "links/mavlink/autopilot_session.py": [
        "no frame from the autopilot",
        "no TIMESYNC replies: latency unknown",
        "stray bytes",
        "closed: blocked",
        "sent late",
    ],
    "links/mavlink/poses/status_texts.py": ["sending poses", "STOPPED: "],
    "links/mavlink/poses/pose_sender.py": ["no poses sent"],
    "links/mavlink/poses/fusion_monitor.py": ["autopilot rejects the position", "autopilot rejects the yaw"],
    "links/mavlink/poses/sent_state.py": [
        "A restart would not know of sent poses",
        "delete it after a reboot of the autopilot",
    ],
    "links/mavlink/origin.py": ["the autopilot does not confirm the origin"],
    "links/mavlink/transport/stream_connection.py": [
        "is lost: is it plugged in and powered?",
        "Reopening",
        "and was closed with its buffer",
    ],
    "links/mavlink/timesync_monitor.py": [
        "TIMESYNC replies take longer than",
        "the autopilot no longer replies to TIMESYNC",
    ],
    "links/mavlink/transport/signing.py": ["the signing time cannot be written"],
    "links/udp/datagrams.py": ["age_s invalid or too large"],
    "links/viewer/viewer.py": ["not all is drawn", "not drawn"],
    "links/zenoh/connection.py": ["does not accept the connection", "has not replied for"],
    "links/zenoh/sender.py": ["does not subscribe to"],
    "links/cli/run_output.py": ["rejected: "],
}


@pytest.mark.parametrize("table", VALUES)
def test_each_value_has_a_row(table: str) -> None:
    first_cells = " ".join(row[0] for row in TABLES[table])
    assert [value for value in VALUES[table] if f"`{value}`" not in first_cells] == []


@pytest.mark.parametrize("table", VALUES)
def test_each_row_has_meaning_and_action(table: str) -> None:
    assert [row for row in TABLES[table] if len(row) != 3 or not all(row)] == []


@pytest.mark.parametrize("source", TEXTS)
def test_each_text_is_on_the_page_and_in_its_source(source: str) -> None:
    code = "".join((ROOT / source).read_text(encoding="utf-8").split('" "'))
    page = " ".join(PAGE.split())
    assert [text for text in TEXTS[source] if text.strip() not in page] == []
    assert [text for text in TEXTS[source] if text not in code] == []


def test_disk_reserve_is_on_the_page() -> None:
    assert f"Below {Recorder().settings.reserve_mb:g} MB of free space" in PAGE


def test_each_fault_has_its_bounds() -> None:
    rows = {row[0]: row[1:4] for row in TABLES["fault"]}
    for name, bounds in BOUNDS.items():
        back = "-" if bounds.back_s is None else f"{bounds.back_s:g}"
        assert rows[name] == [back, f"{bounds.silent_s:g}", str(bounds.poses)], name
    assert rows[KILLED] == [f"{FIRST_POSITION_S:g} (position)", f"{FIRST_POSE_S:g}", "1"]
    assert set(rows) == {*BOUNDS, KILLED}
    page = " ".join(PAGE.split())
    assert f"until {REST_S:g} s after its end" in page
    assert f"takes more than {MAX_RECORDING_LOSS_S:g} s of the recording" in page


def test_the_page_describes_the_unit() -> None:
    parts = unit_file()
    assert f"{float(parts['Service']['RestartSec']):g} s later" in PAGE
    assert float(parts["Service"]["TimeoutStopSec"]) > CLOSE_TIMEOUT_S, "the recorder may need this time to write"
    assert parts["Service"]["ExecStart"].count("--overlay /etc/grd/vehicle.yaml") == 2
    assert "/etc/grd/vehicle.yaml" in PAGE


def test_every_row_has_as_many_cells_as_its_header() -> None:
    lines = PAGE.splitlines()
    wrong = [
        b for a, b in pairwise(lines) if a.startswith("|") and b.startswith("|") and a.count(" | ") != b.count(" | ")
    ]
    assert wrong == []
