"""No estimate of the autopilot reaches an output once a pose was sent: it would be that pose coming back.

All positions, velocities, yaws and rates of the autopilot after the first sent pose are replaced by others, and every
output of every stage stays the same. Roll and pitch stay: they come from its accelerometer.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record, Tap
from flow.message import Message
from flow.replay import replay
from flow.taps import Digest
from links.mavlink.transport.framing import header, parse_frame
from links.recording import RecordingReader, Session
from links.runs.request import RunRequest

mavlink: Any = ardupilotmega
ROOT = Path(__file__).resolve().parents[1]
SENT_S, END_S = 2.7, 4.5  # after the start: the first sent pose, and the end of the replay
POSE = mavlink.MAVLink_odometry_message(
    0, 20, 12, 1.0, 2.0, 3.0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21, 0, 0, 0
)


class Outputs(Tap):
    """A hash of each output of each stage."""

    def __init__(self) -> None:
        super().__init__()
        self.digests: defaultdict[str, Digest] = defaultdict(Digest)

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        if not output.startswith("autopilot."):
            self.digests[output].see(output, message, arrival_ns)

    @property
    def hashes(self) -> dict[str, str]:
        return {output: digest.hexdigest() for output, digest in sorted(self.digests.items())}


def file_of(recording: str) -> Path:
    return ROOT / "recordings" / f"{recording}.mcap"


def first_part(recording: str, sent: bool) -> list[Record]:
    """Records until END_S, with a pose of ours at SENT_S, if any."""
    with RecordingReader(file_of(recording)) as reader:
        records = [r for r in reader.records() if not r.topic.startswith("/truth")]
    start_ns = records[0].arrival_ns
    if sent:
        at_ns = start_ns + round(1e9 * SENT_S)
        frame = bytes(POSE.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=197)))
        records.append(Record("/autopilot/tx", at_ns, at_ns, frame))
    records.sort(key=lambda record: record.arrival_ns)
    return [record for record in records if record.arrival_ns < start_ns + round(1e9 * END_S)]


def falsified(records: list[Record]) -> Iterator[Record]:
    """Every estimate of the autopilot after SENT_S replaced: another place, velocity, yaw and rate, the same tilt."""
    rng, after_ns = np.random.default_rng(5), records[0].arrival_ns + round(1e9 * SENT_S)
    for record in records:
        if record.topic != "/autopilot/rx" or record.arrival_ns <= after_ns:
            yield record
            continue
        message: Any = parse_frame(record.data)
        kind, wrong = message.get_type(), rng.normal(0.0, 5.0, 9)
        if kind in ("ODOMETRY", "LOCAL_POSITION_NED"):
            message.x, message.y, message.z, message.vx, message.vy, message.vz = wrong[:6]
        if kind in ("ODOMETRY", "ATTITUDE"):
            message.rollspeed, message.pitchspeed, message.yawspeed = wrong[6:]
        if kind == "ATTITUDE":
            message.yaw = math.remainder(message.yaw + wrong[0], math.tau)
        if kind == "ODOMETRY":
            message.q = list(wrong[:4] / np.linalg.norm(wrong[:4]))
            message.pose_covariance = [0.0] * 21
            message.reset_counter = int(rng.integers(256))
        (system, component), sequence = header(record.data)
        mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        mav.seq = sequence
        yield Record(record.topic, record.arrival_ns, record.stamp_ns, bytes(message.pack(mav)), record.sequence)


def outputs_of(config: str, recording: str, records: Iterable[Record]) -> dict[str, str]:
    """On the recording's own rig."""
    outputs = Outputs()
    request = RunRequest(ROOT / "configs" / f"{config}.yaml", sets=("viewer.file=null",))
    replay(request.graph_on(Session(file_of(recording))), records, [outputs])
    return outputs.hashes


@pytest.mark.parametrize(("config", "recording"), [("estimate", "experiment_2"), ("vision", "experiment_1")])
def test_no_output_depends_on_the_autopilots_estimate_once_a_pose_was_sent(config: str, recording: str):
    records = first_part(recording, sent=True)
    hashes = outputs_of(config, recording, records)
    assert {"detect.candidates", "track.track_state", "fuse.relative_pose"} <= hashes.keys()
    assert ("align.relative_rotation" in hashes) == (config == "vision")
    assert outputs_of(config, recording, falsified(records)) == hashes


def test_without_a_sent_pose_the_outputs_depend_on_it():
    name, records = "experiment_2", first_part("experiment_2", sent=False)
    before, after = (outputs_of("estimate", name, some) for some in (records, falsified(records)))
    assert {name for name in before if before[name] != after[name]} >= {"detect.candidates", "telemetry.drone_odometry"}
