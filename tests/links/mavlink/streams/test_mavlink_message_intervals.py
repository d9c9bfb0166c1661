"""Requested message rates: acknowledged, denied, unsupported, unanswered, fallen and lost in a reboot."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.streams.message_intervals import MessageIntervals, MessageRates
from tests.links.mavlink.mavlink_poses import HOST0, MS

mavlink: Any = ardupilotmega
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
SET_MESSAGE_INTERVAL = 511
RAW_IMU, ATTITUDE, POSITION, ESTIMATOR, SCALED_IMU, HIGHRES_IMU = 27, 30, 32, 193, 26, 105


def ack(result: int, command: int = SET_MESSAGE_INTERVAL, requester: tuple[int, int] = (0, 0)) -> Any:
    return mavlink.MAVLink_command_ack_message(command, result, 0, 0, *requester)


class Peer:
    """An autopilot that answers by `results` (message id -> result) and sends what it accepted, 50 steps a second."""

    def __init__(self, intervals: MessageIntervals, results: Any = None, answers: bool = True) -> None:
        self.intervals, self.results, self.answers = intervals, results or {}, answers
        self.now_ns, self.boot_ms = HOST0, 60_000
        self.requests: list[tuple[int, float]] = []
        self.interval_us: dict[int, float] = {}
        self.factor = 1.0  # of the sent intervals
        self._sent_us: Counter[int] = Counter()
        self._kinds = {
            RAW_IMU: lambda: mavlink.MAVLink_raw_imu_message(self.boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            SCALED_IMU: lambda: mavlink.MAVLink_scaled_imu_message(self.boot_ms, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            ATTITUDE: lambda: mavlink.MAVLink_attitude_message(self.boot_ms, 0, 0, 0, 0, 0, 0),
            ESTIMATOR: lambda: mavlink.MAVLink_ekf_status_report_message(0, 0, 0, 0, 0, 0, 0),
            POSITION: lambda: mavlink.MAVLink_local_position_ned_message(self.boot_ms, 0, 0, 0, 0, 0, 0),
        }

    def run(self, seconds: float) -> Peer:
        for _ in range(round(50 * seconds)):
            self.now_ns += 20 * MS
            self.boot_ms += 20
            request = self.intervals.due(self.now_ns)
            if request is not None:
                self._answer(request)
            for message_id, interval_us in self.interval_us.items():
                self._sent_us[message_id] += 20_000
                if self._sent_us[message_id] >= self.factor * interval_us and message_id in self._kinds:
                    self._sent_us[message_id] = 0
                    self.intervals.on_message(self._kinds[message_id](), self.now_ns)
        return self

    def _answer(self, request: Any) -> None:
        assert (request.get_type(), request.command) == ("COMMAND_LONG", SET_MESSAGE_INTERVAL)
        assert [request.param3, request.param4, request.param5, request.param6, request.param7] == [0] * 5
        message_id, interval_us = round(request.param1), request.param2
        self.requests.append((message_id, round(1e6 / interval_us, 3)))
        if not self.answers:
            return
        result = self.results.get(message_id, ACCEPTED)
        result = result(1e6 / interval_us) if callable(result) else result
        if result == ACCEPTED:
            self.interval_us[message_id] = interval_us
        self.intervals.on_message(ack(result), self.now_ns)


def intervals(profile: Any = "ardupilot", **rates: float) -> MessageIntervals:
    return MessageIntervals(MessageRates(**rates), profile, (1, 1), (1, 197))


def requested(link: MessageIntervals, now_ns: int) -> int:
    request = link.due(now_ns)
    assert request is not None
    return round(request.param1)


def test_each_message_is_requested_once_when_the_autopilot_accepts():
    peer = Peer(intervals()).run(30)
    assert peer.requests == [(RAW_IMU, 50.0), (ATTITUDE, 25.0), (POSITION, 25.0), (ESTIMATOR, 5.0)]
    assert peer.intervals.status is None
    assert peer.intervals.imu_rate_hz() == pytest.approx(50, abs=1)


def test_px4_is_asked_for_its_own_messages():
    peer = Peer(intervals("px4")).run(1)
    assert [message_id for message_id, _ in peer.requests] == [HIGHRES_IMU, ATTITUDE, POSITION, 230]


def test_a_rate_of_zero_is_not_requested():
    peer = Peer(intervals(imu_hz=0, attitude_hz=0, position_hz=0)).run(9)
    assert peer.requests == [(ESTIMATOR, 5.0)]
    assert peer.intervals.status is None


def test_only_one_request_is_under_way_and_only_its_acknowledgement_counts():
    link = intervals()
    assert requested(link, HOST0) == RAW_IMU
    assert link.due(HOST0 + 10 * MS) is None
    link.on_message(ack(ACCEPTED, command=512), HOST0 + 20 * MS)
    link.on_message(ack(ACCEPTED, requester=(255, 190)), HOST0 + 20 * MS)
    assert link.due(HOST0 + 30 * MS) is None
    link.on_message(ack(ACCEPTED, requester=(1, 197)), HOST0 + 40 * MS)
    assert requested(link, HOST0 + 50 * MS) == ATTITUDE


def test_a_denied_rate_is_halved_until_it_is_accepted():
    peer = Peer(intervals(), {RAW_IMU: lambda hz: ACCEPTED if hz <= 20 else DENIED}).run(5)
    assert [hz for message_id, hz in peer.requests if message_id == RAW_IMU] == [50.0, 25.0, 12.5]
    assert peer.intervals.counters["message interval denied: RAW_IMU at 50 Hz"] == 1
    assert peer.intervals.status is None, "12.5 Hz is enough"


def test_an_unsupported_imu_message_is_replaced_by_the_scaled_one():
    peer = Peer(intervals(), {RAW_IMU: FAILED}).run(5)
    assert (SCALED_IMU, 50.0) in peer.requests
    assert peer.intervals.status is None
    assert peer.intervals.imu_rate_hz() == pytest.approx(50, abs=1)


def test_a_rejected_imu_is_a_status_with_advice_and_is_requested_again():
    peer = Peer(intervals(attitude_hz=0, position_hz=0, estimator_hz=0), {RAW_IMU: UNSUPPORTED, SCALED_IMU: FAILED})
    peer.run(5)
    assert peer.requests == [(RAW_IMU, 50.0), (SCALED_IMU, 50.0)]
    status = peer.intervals.status
    assert status is not None
    assert "SCALED_IMU arrives at 0.0 Hz, at least 10 Hz are needed; the autopilot rejects it" in status
    assert "SRn_RAW_SENS" in status
    peer.results = {}
    assert peer.run(20).intervals.status is None


def test_a_request_without_acknowledgement_is_repeated_and_reported():
    peer = Peer(intervals(), answers=False).run(12)
    assert [message_id for message_id, _ in peer.requests[:4]] == [RAW_IMU, ATTITUDE, POSITION, ESTIMATOR]
    assert peer.requests[4] == (RAW_IMU, 50.0)
    assert peer.intervals.counters["message interval not acknowledged"] >= 10
    assert "the autopilot does not answer" in (peer.intervals.status or "")
    peer.answers = True
    assert peer.run(20).intervals.status is None


def test_a_busy_autopilot_is_asked_again_after_a_second():
    peer = Peer(intervals(), {RAW_IMU: BUSY}).run(0.9)
    assert [message_id for message_id, _ in peer.requests].count(RAW_IMU) == 1
    assert [message_id for message_id, _ in peer.run(0.5).requests].count(RAW_IMU) == 2


def test_a_rate_that_falls_after_the_acknowledgement_is_requested_again_at_once():
    """As after REQUEST_DATA_STREAM of another station, which MAVProxy sends every 15 s."""
    peer = Peer(intervals()).run(15)
    assert len(peer.requests) == 4
    for _ in range(3):
        peer.interval_us = dict.fromkeys(peer.interval_us, 250_000.0)
        peer.run(2.5)
        assert peer.interval_us == {RAW_IMU: 20_000, ATTITUDE: 40_000, POSITION: 40_000, ESTIMATOR: 250_000}
        peer.run(12.5)
    assert peer.intervals.counters["message interval renewed: RAW_IMU"] == 3
    assert len(peer.requests) == 13
    assert peer.intervals.status is None


def test_a_message_that_does_not_reach_its_rate_is_reported_and_seldom_requested_again():
    """As where the link is too slow."""
    peer = Peer(intervals(attitude_hz=0, position_hz=0, estimator_hz=0)).run(15)
    peer.factor = 25.0
    peer.run(5)
    assert "RAW_IMU arrives at 2.0 Hz, at least 10 Hz are needed; the autopilot accepted more" in (
        peer.intervals.status or ""
    )
    assert len(peer.requests) == 2
    assert 4 <= len(peer.run(30).requests) <= 5


def test_a_message_once_a_second_is_not_taken_for_one_that_fell():
    peer = Peer(MessageIntervals(MessageRates(), "ardupilot", (1, 1), (1, 197), least_gps_hz=1.0))
    peer._kinds[24] = lambda: mavlink.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9)
    assert len(peer.run(60).requests) == 5


def test_after_a_boot_or_a_silence_the_requests_start_again():
    peer = Peer(intervals(estimator_hz=0)).run(5)
    assert len(peer.requests) == 3
    peer.intervals.restart()
    assert len(peer.run(3).requests) == 6
    assert peer.intervals.counters["message intervals restarted"] == 1


def test_a_request_that_could_not_be_sent_is_sent_later():
    link = intervals()
    assert requested(link, HOST0) == RAW_IMU
    link.on_not_sent()
    assert requested(link, HOST0 + 50 * MS) == RAW_IMU
