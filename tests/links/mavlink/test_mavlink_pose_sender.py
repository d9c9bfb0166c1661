"""When poses go out, what is said about those that do not, and when the reset counter changes."""

from __future__ import annotations

from typing import Any

import pytest
from mavlink_poses import HOST0, MS, good_pose

from links.mavlink.gate import PoseLimits
from links.mavlink.pose_sender import TEXT_BYTES, PoseSender
from stages.messages import PoseState


class Line:
    """Speaks poses at a rate and keeps what went out."""

    def __init__(self, **settings: Any) -> None:
        self.pose_sender = PoseSender(("odometry",), PoseLimits(), **settings)
        self.now_ns = HOST0
        self.counters: list[int] = []
        self.texts: list[tuple[int, str]] = []

    def pose(self, after_ms: int = 20, through: bool = True, **changes: Any) -> int:
        self.now_ns += after_ms * MS
        pose = good_pose(self.now_ns, **changes)
        messages = self.pose_sender.messages(pose, self.now_ns)
        if messages and through:
            self.pose_sender.on_sent(pose, self.now_ns)
            self.counters += [m.reset_counter for m in messages]
        self.listen()
        return len(messages)

    def wait(self, ms: int) -> None:
        for _ in range(ms // 50):
            self.now_ns += 50 * MS
            self.listen()

    def listen(self) -> None:
        self.texts += [(m.severity, m.text) for m in self.pose_sender.due_texts(self.now_ns)]


def test_the_counter_stays_while_poses_come_without_a_gap_or_jump():
    line = Line(reset_counter=250)
    for _ in range(50):
        line.pose()
    assert set(line.counters) == {250}


@pytest.mark.parametrize("jump", [{"resets": 1}, {"resets": 256}, {"track_id": 2}])
def test_any_jump_of_the_pose_changes_the_counter_once(jump: Any):
    line = Line(reset_counter=255)
    line.pose()
    for _ in range(5):
        line.pose(**jump)
    assert line.counters == [255, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("gap_ms", "counters"), [(290, [0, 0]), (310, [0, 1])])
def test_a_silence_that_the_autopilot_noticed_changes_the_counter(gap_ms: int, counters: list[int]):
    line = Line()
    line.pose()
    line.pose(after_ms=gap_ms)
    assert line.counters == counters


def test_a_silence_of_refused_poses_is_a_silence():
    line = Line()
    line.pose()
    for _ in range(20):
        assert line.pose(state=PoseState.AMBIGUOUS) == 0
    line.pose()
    assert line.counters == [0, 1]


def test_poses_that_the_line_did_not_take_are_a_silence_too_and_count_once():
    line = Line()
    line.pose()
    for _ in range(300):
        line.pose(through=False)
    line.pose()
    line.pose()
    assert line.counters == [0, 1, 1]


def test_a_jump_during_a_silence_is_one_change():
    line = Line()
    line.pose()
    line.pose(after_ms=2000, resets=3, track_id=4)
    assert line.counters == [0, 1]


def test_a_pose_that_is_not_newer_does_not_go_out_and_stops_nothing():
    line = Line()
    line.pose()
    assert line.pose(after_ms=0) == 0
    assert line.pose_sender.sending


def test_it_stops_loudly_and_says_when_it_goes_on():
    line = Line()
    for _ in range(60):
        line.pose()
    for _ in range(60):
        line.pose(state=PoseState.AMBIGUOUS, reason="street and side street look alike")
    for _ in range(60):
        line.pose()
    severities = {text: severity for severity, text in line.texts}
    assert severities["grd: STOPPED: ambiguous rotation"] == 2  # critical
    assert severities["grd: sending poses"] == 5
    assert severities["grd: AMBIGUOUS: street and side street look alike"] == 4
    assert [text for _, text in line.texts].index(
        "grd: STOPPED: ambiguous rotation"
    ) == 2  # before the state's own text
    assert line.pose_sender.sending


def test_poses_that_stop_coming_are_noticed_without_a_pose():
    line = Line()
    line.pose()
    line.wait(2000)
    assert (2, "grd: STOPPED: no poses sent") in line.texts
    assert not line.pose_sender.sending


def test_flapping_says_no_more_than_two_texts_a_second_and_ends_with_the_truth():
    line = Line()
    for i in range(500):
        line.pose(state=PoseState.FULL if i % 2 else PoseState.LOST)
    assert len(line.texts) <= 21  # 10 s
    for _ in range(100):
        line.pose()
    told_of_output = [text for _, text in line.texts if "sending" in text or "STOPPED" in text]
    assert told_of_output[-1] == "grd: sending poses"
    assert [text for _, text in line.texts if "FULL" in text or "LOST" in text][-1].startswith("grd: FULL")


def test_a_text_that_the_line_did_not_take_waits_unless_a_newer_one_does():
    line = Line()
    line.pose()
    line.wait(1000)  # said: sending, FULL, STOPPED, each in its turn
    line.wait(1000)
    line.pose()
    line.wait(250)
    pose_sender, now_ns = line.pose_sender, line.now_ns + 600 * MS
    (first,) = pose_sender.due_texts(now_ns)
    assert first.text == "grd: STOPPED: no poses sent"
    pose_sender.on_text_not_sent()
    (again,) = pose_sender.due_texts(now_ns + MS)  # at once
    assert again.text == first.text
    pose_sender.on_text_not_sent()
    line.now_ns = now_ns
    line.pose()
    assert line.texts[-1][1] == "grd: sending poses"


def test_nothing_to_send_is_no_sending_and_no_stop():
    pose_sender = PoseSender((), PoseLimits())
    assert pose_sender.messages(good_pose(), HOST0) == []
    assert not pose_sender.sending
    texts = [m.text for i in range(40) for m in pose_sender.due_texts(HOST0 + 100 * i * MS)]
    assert texts == ["grd: FULL: lidar and both cameras"]


def test_a_text_fits_its_field_whatever_the_reason_is():
    line = Line()
    line.pose(state=PoseState.LOST, reason="Straße " * 30)
    assert len(line.texts[0][1]) == TEXT_BYTES
    assert line.texts[0][1].startswith("grd: LOST: Stra?e")
