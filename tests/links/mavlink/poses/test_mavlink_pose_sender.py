"""When poses are sent, which texts report those that are not, and when the reset counter changes."""

from __future__ import annotations

from typing import Any

import pytest

from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.pose_sender import TEXT_BYTES, PoseSender
from stages.messages import PoseState
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose


class Output:
    """Sends poses at a rate and keeps the sent counters and texts."""

    def __init__(self, **settings: Any) -> None:
        self.pose_sender = PoseSender(("odometry",), PoseLimits(), yaw="cameras", **settings)
        self.now_ns = HOST0
        self.counters: list[int] = []
        self.texts: list[tuple[int, str]] = []

    def pose(self, after_ms: int = 20, sent: bool = True, **changes: Any) -> int:
        self.now_ns += after_ms * MS
        pose = good_pose(self.now_ns, **changes)
        messages = self.pose_sender.messages(pose, self.now_ns)
        if messages and sent:
            self.pose_sender.on_sent(pose, self.now_ns)
            self.counters += [m.reset_counter for m in messages]
        self.collect()
        return len(messages)

    def wait(self, ms: int) -> None:
        for _ in range(ms // 50):
            self.now_ns += 50 * MS
            self.collect()

    def collect(self) -> None:
        self.texts += [(m.severity, m.text) for m in self.pose_sender.due_texts(self.now_ns)]


def test_the_counter_is_constant_without_gaps_and_jumps():
    output = Output(reset_counter=250)
    for _ in range(50):
        output.pose()
    assert set(output.counters) == {250}


@pytest.mark.parametrize("jump", [{"resets": 1}, {"resets": 256}, {"track_id": 2}])
def test_any_jump_of_the_pose_changes_the_counter_once(jump: Any):
    output = Output(reset_counter=255)
    output.pose()
    for _ in range(5):
        output.pose(**jump)
    assert output.counters == [255, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("gap_ms", "counters"), [(290, [0, 0]), (310, [0, 1])])
def test_a_gap_that_the_autopilot_notices_changes_the_counter(gap_ms: int, counters: list[int]):
    output = Output()
    output.pose()
    output.pose(after_ms=gap_ms)
    assert output.counters == counters


def test_a_gap_of_rejected_poses_changes_the_counter():
    output = Output()
    output.pose()
    for _ in range(20):
        assert output.pose(state=PoseState.AMBIGUOUS) == 0
    output.pose()
    assert output.counters == [0, 1]


def test_poses_that_could_not_be_sent_are_a_gap_and_count_once():
    output = Output()
    output.pose()
    for _ in range(300):
        output.pose(sent=False)
    output.pose()
    output.pose()
    assert output.counters == [0, 1, 1]


def test_a_jump_during_a_gap_is_one_change():
    output = Output()
    output.pose()
    output.pose(after_ms=2000, resets=3, track_id=4)
    assert output.counters == [0, 1]


def test_a_pose_that_is_not_newer_is_not_sent_and_stops_nothing():
    output = Output()
    output.pose()
    assert output.pose(after_ms=0) == 0
    assert output.pose_sender.sending


def test_stopping_and_resuming_is_reported():
    output = Output()
    for _ in range(60):
        output.pose()
    for _ in range(60):
        output.pose(state=PoseState.AMBIGUOUS, reason="street and side street are similar")
    for _ in range(60):
        output.pose()
    severities = {text: severity for severity, text in output.texts}
    assert severities["grd: STOPPED: ambiguous rotation"] == 2  # critical
    assert severities["grd: sending poses"] == 5
    assert severities["grd: AMBIGUOUS: street and side street are similar"] == 4
    assert [text for _, text in output.texts].index(
        "grd: STOPPED: ambiguous rotation"
    ) == 2  # before the text of the state
    assert output.pose_sender.sending


def test_missing_poses_are_noticed_without_a_pose():
    output = Output()
    output.pose()
    output.wait(2000)
    assert (2, "grd: STOPPED: no poses sent") in output.texts
    assert not output.pose_sender.sending


def test_flapping_states_send_at_most_two_texts_per_second_and_end_with_the_current_state():
    output = Output()
    for i in range(500):
        output.pose(state=PoseState.FULL if i % 2 else PoseState.LOST)
    assert len(output.texts) <= 21  # 10 s
    for _ in range(100):
        output.pose()
    output_texts = [text for _, text in output.texts if "sending" in text or "STOPPED" in text]
    assert output_texts[-1] == "grd: sending poses"
    assert [text for _, text in output.texts if "FULL" in text or "LOST" in text][-1].startswith("grd: FULL")


def test_a_text_that_could_not_be_sent_is_kept_unless_a_newer_one_replaces_it():
    output = Output()
    output.pose()
    output.wait(1000)  # sent: sending, FULL, STOPPED, one after the other
    output.wait(1000)
    output.pose()
    output.wait(250)
    pose_sender, now_ns = output.pose_sender, output.now_ns + 600 * MS
    (first,) = pose_sender.due_texts(now_ns)
    assert first.text == "grd: STOPPED: no poses sent"
    pose_sender.on_text_not_sent()
    (repeated,) = pose_sender.due_texts(now_ns + MS)  # immediately
    assert repeated.text == first.text
    pose_sender.on_text_not_sent()
    output.now_ns = now_ns
    output.pose()
    assert output.texts[-1][1] == "grd: sending poses"


def test_without_messages_nothing_is_sent_or_stopped():
    pose_sender = PoseSender((), PoseLimits(), yaw="cameras")
    assert pose_sender.messages(good_pose(), HOST0) == []
    assert not pose_sender.sending
    texts = [m.text for i in range(40) for m in pose_sender.due_texts(HOST0 + 100 * i * MS)]
    assert texts == ["grd: FULL: lidar and both cameras"]


def test_a_text_fits_its_field_for_any_reason():
    output = Output()
    output.pose(state=PoseState.LOST, reason="Straße " * 30)
    assert len(output.texts[0][1]) == TEXT_BYTES
    assert output.texts[0][1].startswith("grd: LOST: Stra?e")
