"""The operator's page names what grd may say, so that nobody meets a word in the field that it does not explain.

Each word is asked for where it is explained: in the first column of its own table. What is said in sentences must stand
in the source that says it, too, so that neither changes alone.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

from links.dynamixel.wire import Health
from links.mavlink.gate import RejectReason as GateRejectReason
from links.recording import Recorder
from links.recording.writer import CLOSE_TIMEOUT_S
from links.velodyne.position import Pps
from links.velodyne.reject_reason import RejectReason
from stages.messages import BranchState, PoseState, TrackingState
from tests.links.fault_bounds import KEPT_S, KILLED, MUST, POSES_AGAIN_S, POSITION_AGAIN_S, REST_S
from tests.unit_file import unit_file

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "deploy" / "OPERATOR.md").read_text(encoding="utf-8")
TABLE = re.compile(r"^\| (?P<head>[^|]+?) \|.*\n\| ---.*\n(?P<rows>(?:\|.*\n)+)", re.MULTILINE)
TABLES = {
    found["head"]: [re.split(r"(?<!\\) \| ", row.strip("| ")) for row in found["rows"].splitlines()]
    for found in TABLE.finditer(PAGE)
}
EXPLAINED = {
    "state of the pose": [state.name for state in PoseState],
    "state of the track (shown while there is no pose yet)": [state.name for state in TrackingState],
    "state of the rotation by cameras": [state.name for state in BranchState],
    "why no pose goes out": [why.value for why in GateRejectReason],
    "LiDAR": ["decoded", "lost", "from other senders", *(f"PPS {pps.name.lower()}" for pps in Pps), "PPS locks lost"],
    "LiDAR, `refused: ` and why": [why.value for why in RejectReason],
    "servo": list(Health._fields),
}
SAID = {  # where it is said, and what
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
    "links/velodyne/udp.py": ["cannot listen on UDP", "is the network interface still up?", "no packet on UDP"],
    "links/velodyne/lidar.py": [
        "packets in a row are no use",
        "these packets come from a Velodyne",
        "the sensor's clock is not locked to UTC",
        "is locked to UTC no more",
        "no position packet comes any more",
    ],
    "links/camera/camera.py": ["but the lens is calibrated for"],
    "links/camera/capture.py": ["cannot be opened as a camera", "gives no more frames", "stale", "damaged"],
    "links/camera/live_camera.py": ["overtaken", "lost", "opened again"],
    "links/dynamixel/drive.py": ["the servo is not set up for grd: "],
    "links/dynamixel/worker.py": ["does not answer at"],
    "links/dynamixel/servo.py": [
        "stands still: ",
        "it is set up again by itself",
        "the servo's process ended",
        "the servo stays where it is",
        "process restarts",
        "stopped: nobody aims",
    ],
    "links/mavlink/autopilot_session.py": [
        "no word from the autopilot",
        "answers no TIMESYNC: late is not seen",
        "stray bytes",
    ],
    "links/mavlink/pose_sender.py": ["sending poses", "STOPPED: ", "no pose goes out"],
    "links/mavlink/transport/stream_connection.py": [
        "is gone: is it plugged in and powered?",
        "Trying again",
        "and was dropped with it",
    ],
    "links/mavlink/timesync_monitor.py": [
        "answers to TIMESYNC take longer than",
        "the autopilot has answered TIMESYNC and does no more",
    ],
    "links/mavlink/signing.py": ["the signing time cannot be written"],
    "links/vehicle_odometry/udp.py": ["too old, or of no age"],
    "links/viewer/viewer.py": ["not all is drawn", "not drawn"],
    "links/zenoh/connection.py": ["does not take us in", "has not answered for"],
    "links/zenoh/sender.py": ["does not listen to"],
    "links/cli/run.py": ["rejected: "],
}


@pytest.mark.parametrize("table", EXPLAINED)
def test_each_word_has_its_row(table: str) -> None:
    first_cells = " ".join(row[0] for row in TABLES[table])
    assert [word for word in EXPLAINED[table] if f"`{word}`" not in first_cells] == []


@pytest.mark.parametrize("table", EXPLAINED)
def test_each_row_says_what_it_means_and_what_to_do(table: str) -> None:
    assert [row for row in TABLES[table] if len(row) != 3 or not all(row)] == []


@pytest.mark.parametrize("source", SAID)
def test_what_is_said_in_sentences_stands_on_the_page_and_in_its_source(source: str) -> None:
    code = "".join((ROOT / source).read_text(encoding="utf-8").split('" "'))
    page = " ".join(PAGE.split())
    assert [text for text in SAID[source] if text.strip() not in page] == []
    assert [text for text in SAID[source] if text not in code] == []


def test_what_is_not_recorded_for_want_of_room_is_told_in_figures() -> None:
    assert f"Below {Recorder().settings.reserve_mb:g} MB" in PAGE


def test_each_fault_stands_with_its_bounds() -> None:
    told = {row[0]: row[1:4] for row in TABLES["fault"]}
    for name, must in MUST.items():
        back = "-" if must.back_s is None else f"{must.back_s:g}"
        assert told[name] == [back, f"{must.silent_s:g}", str(must.poses)], name
    assert told[KILLED] == [f"{POSITION_AGAIN_S:g} (position)", f"{POSES_AGAIN_S:g}", "1"]
    assert set(told) == {*MUST, KILLED}
    assert f"until {REST_S:g} s after its end" in PAGE
    assert f"takes more than {KEPT_S:g} s of the recording".replace(" 0.", " .") in PAGE


def test_the_page_says_what_the_unit_does() -> None:
    parts = unit_file()
    assert f"{float(parts['Service']['RestartSec']):g} s later".removeprefix("0") in PAGE
    assert float(parts["Service"]["TimeoutStopSec"]) > CLOSE_TIMEOUT_S, (
        "the recorder may take so long to write what waits"
    )
    assert parts["Service"]["ExecStart"].count("--overlay /etc/grd/vehicle.yaml") == 2
    assert "/etc/grd/vehicle.yaml" in PAGE


def test_every_table_is_as_wide_as_its_head() -> None:
    lines = PAGE.splitlines()
    odd = [
        b for a, b in pairwise(lines) if a.startswith("|") and b.startswith("|") and a.count(" | ") != b.count(" | ")
    ]
    assert odd == []
