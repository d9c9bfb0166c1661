"""Preflight checks of the autopilot on frames made by hand."""

from __future__ import annotations

import dataclasses
import errno
import os

import pytest
from pymavlink.dialects.v20 import ardupilotmega as m

from flow.link import LinkError, Record
from links.mavlink import Autopilot
from links.mavlink.checks import _estimate, autopilot_checks, parameter_check, version_check
from links.mavlink.origin import OriginState
from links.mavlink.parameters import ParameterValues, ask_parameters
from links.mavlink.profiles import ARDUPILOT, PX4, required_parameters
from links.mavlink.transport.framing import packed
from links.preflight.check_result import Level
from stages.messages import AutopilotEstimator, AutopilotStatus
from tests.links.preflight.observed import observe
from tests.links.preflight.preflight_peers import good_parameters

BEGIN_NS, S, MS = 1_748_773_230_000_000_000, 1_000_000_000, 1_000_000


def frames(
    seconds=4.0, *, system=1, autopilot=3, beats=True, attitude_hz=50, odometry_hz=30, base_mode=0, lose=0, quiet=None
):
    """Frames of an autopilot, in order. `quiet`: a message that is missing for 1.5 s, one second before the end."""
    mav, records = m.MAVLink(None, srcSystem=system, srcComponent=1), []
    for k in range(int(seconds * 100)):
        at_ms = k * 10
        now = []
        if beats and at_ms % 1000 == 0:
            now.append(m.MAVLink_heartbeat_message(2, autopilot, base_mode, 0, 3, 3))
        if attitude_hz and at_ms % (1000 // attitude_hz // 10 * 10) == 0:
            now.append(m.MAVLink_attitude_message(5000 + at_ms, 0, 0, 0, 0, 0, 0))
        if odometry_hz and at_ms % (1000 // odometry_hz // 10 * 10) == 0:
            now.append(m.MAVLink_local_position_ned_message(5000 + at_ms, 0, 0, 0, 0, 0, 0))
        for message in now:
            if message.get_type() == quiet and 0 < 1000 * (seconds - 1) - at_ms <= 1500:
                continue
            at_ns = BEGIN_NS + at_ms * MS
            records.append(Record("/autopilot/rx", at_ns, at_ns, packed(message, mav)))
    return records[: len(records) // 2] + records[len(records) // 2 + lose :]


def status(offset_ns=S, error_ns=2 * MS, armed=False, failsafe=False):
    return AutopilotStatus(
        stamp_ns=BEGIN_NS,
        armed=armed,
        custom_mode=0,
        failsafe=failsafe,
        lost_frames=0,
        clock_offset_ns=offset_ns,
        clock_uncertainty_ns=error_ns,
    )


def estimator(ratio=0.1, position=True, attitude=True, constant=False):
    return AutopilotEstimator(
        stamp_ns=BEGIN_NS,
        attitude_good=attitude,
        velocity_good=True,
        position_good=position,
        height_good=True,
        constant_position=constant,
        velocity_ratio=ratio,
        horizontal_ratio=ratio,
        height_ratio=ratio,
        compass_ratio=0.0,
        flags=0,
    )


STATUS, ESTIMATORS = status(), (estimator(),)


def check(records, *, newest=STATUS, estimators=ESTIMATORS, **kinds):
    source = observe(Autopilot(), records, **kinds)
    return {v.name: v for v in autopilot_checks(source, [newest] if records else [], estimators)}


def test_an_autopilot_that_sends_all_needed_messages_passes():
    found = check(frames())
    assert {v.level for v in found.values()} == {Level.OK}
    assert set(found) == {f"it {what}" for what in ("heartbeat", "frames", "clock", "rates", "estimate")}
    assert "1.0 Hz, ardupilot, disarmed" in found["it heartbeat"].sentence
    assert "ATTITUDE 50 Hz" in found["it rates"].sentence


@pytest.mark.parametrize(
    ("records", "given", "name", "expected_text"),
    [
        (frames(autopilot=12), {}, "heartbeat", "set profile: px4"),
        (frames(), {"newest": status(armed=True)}, "heartbeat", "disarm it"),
        (frames(), {"newest": status(failsafe=True)}, "heartbeat", "emergency"),
        (frames(), {"end_ns": BEGIN_NS + 9 * S}, "heartbeat", "none for 6.0 s"),
        (frames(lose=100), {}, "frames", "100 of"),
        (frames(), {"newest": status(error_ns=80 * MS)}, "clock", "+- 80.0 ms"),
        (frames(), {"newest": status(offset_ns=None, error_ns=None)}, "clock", "no message has a time stamp"),
        (frames(), {"counters": {"clock restarts": 2}}, "clock", "was reset 2 times"),
        (frames(attitude_hz=0), {}, "rates", "attitude is needed"),
        (frames(), {"estimators": [estimator(attitude=False)]}, "estimate", "no attitude yet"),
        (frames(), {"estimators": [estimator(ratio=1.6)]}, "estimate", "rejects velocity (1.6)"),
    ],
)
def test_an_autopilot_that_is_not_ready_fails(records, given, name, expected_text):
    found = check(records, **given)[f"it {name}"]
    assert found.level is Level.FAIL
    assert expected_text in found.sentence


@pytest.mark.parametrize(
    ("records", "given", "name"),
    [
        (frames(lose=10), {}, "frames"),
        (frames(), {"counters": {"from other senders": 3}}, "frames"),
        (frames(), {"newest": status(error_ns=None)}, "clock"),
        (frames(), {"newest": status(error_ns=20 * MS)}, "clock"),
        (frames(odometry_hz=0), {}, "rates"),
        (frames(attitude_hz=5), {}, "rates"),
        (frames(), {"estimators": []}, "estimate"),
        (frames(), {"estimators": [estimator(position=False, constant=True)]}, "estimate"),
        (frames(), {"estimators": [estimator(ratio=0.8)]}, "estimate"),
    ],
)
def test_degraded_states_are_warnings(records, given, name):
    assert check(records, **given)[f"it {name}"].level is Level.WARNING


def test_gaps_that_the_rate_hides_are_reported():
    gaps = check(frames(8.0, quiet="ATTITUDE"))["it rates"]
    assert gaps.level is Level.FAIL
    assert "no attitude for 1.5 s, at most 1 s allowed" in gaps.sentence
    recorded = check(frames(8.0, quiet="ATTITUDE"), live=False)["it rates"]
    assert recorded.level is Level.WARNING
    no_position = check(frames(8.0, quiet="LOCAL_POSITION_NED"))["it rates"]
    assert no_position.level is Level.WARNING
    assert "no odometry or position for 1.5 s, at most 1 s allowed" in no_position.sentence
    stopped = check(frames(), end_ns=BEGIN_NS + 6 * S)["it rates"]
    assert stopped.level is Level.FAIL
    assert "no attitude for 2.0 s" in stopped.sentence


def test_timesync_replies_for_another_component_are_distinguished_from_none():
    none = check(frames(), newest=status(error_ns=None))["it clock"]
    assert "does it receive our frames" in none.sentence
    early = check(frames(), newest=status(error_ns=None), counters={"timesync replies": 40})["it clock"]
    assert "its TIMESYNC replies are earlier than its other messages allow" in early.sentence
    foreign = check(frames(), newest=status(error_ns=None), rejected={"TIMESYNC for another component": 7})["it clock"]
    assert "7 were for another component: check own_system_id, own_component_id" in foreign.sentence


def test_a_silent_autopilot_and_one_with_another_id_are_distinguished():
    assert "no frame from system 1, component 1" in check([])["it heartbeat"].sentence
    other = check(frames(system=9))["it heartbeat"]
    assert other.level is Level.FAIL
    assert "from system 9 component 1" in other.sentence
    mute = check(frames(beats=False))["it heartbeat"]
    assert "but other messages" in mute.sentence
    old = check([], counters={"signed with our key, but not new": 8})["it heartbeat"]
    assert "8 frames signed with an old time: does it receive our frames?" in old.sentence
    unsigned = check([], counters={"not signed with our key": 8})["it heartbeat"]
    assert "8 frames without a valid signature" in unsigned.sentence


def test_a_recorded_flight_may_be_armed():
    assert check(frames(), newest=status(armed=True), live=False)["it heartbeat"].level is Level.OK


@pytest.mark.parametrize("profile", ["ardupilot", "px4"])
def test_parameters_are_compared_with_the_profile(profile):
    good, required = good_parameters(profile), required_parameters(profile, "none")
    assert parameter_check("it", required, ParameterValues(good, [], 40)).level is Level.OK
    first, second = list(good)[:2]
    bad = parameter_check("it", required, ParameterValues({**good, first: 102.0} | {second: 98.0}, [], 40))
    assert bad.level is Level.FAIL
    assert f"{first} is 102" in bad.sentence
    assert f"{second} is 98" in bad.sentence
    assert "does not reply" in parameter_check("it", required, ParameterValues({}, list(good), 0)).sentence
    assert "none was received" in parameter_check("it", required, ParameterValues({}, list(good), 9)).sentence


@pytest.mark.parametrize(
    ("profile", "version", "level", "text"),
    [
        (ARDUPILOT, (4, 6, 3), Level.OK, "ardupilot 4.6.3"),
        (ARDUPILOT, (4, 5, 7), Level.FAIL, "ardupilot 4.5.7: 4.6 or later is needed: earlier ones reset"),
        (ARDUPILOT, (4, 7, 0), Level.FAIL, "ardupilot 4.7.0: before 4.7 is needed: ARMING_SKIPCHK replaces"),
        (ARDUPILOT, None, Level.WARNING, "check that it is ardupilot 4.6"),
        (PX4, (1, 16, 0), Level.OK, "px4 1.16.0"),
        (PX4, (1, 13, 3), Level.FAIL, "1.14 or later is needed"),
    ],
)
def test_a_firmware_that_is_not_supported_is_found(profile, version, level, text):
    result = version_check("it", profile, version)
    assert (result.level, text in result.sentence) == (level, True)


def test_a_full_disk_for_the_signing_time_is_an_error_in_preflight(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    monkeypatch.setattr("links.mavlink.transport.signing.os.fsync", full)
    with pytest.raises(LinkError, match="signing time cannot be written: No space left"):
        ask_parameters(Autopilot(connection="udpin:127.0.0.1:0", signing_key=key))


def test_the_clock_drift_is_reported_if_known():
    drifting = dataclasses.replace(status(), clock_drift_ppm=-18.04, clock_drift_sigma_ppm=1.4)
    assert "drift -18.0 +- 1.4 ppm" in check(frames(), newest=drifting)["it clock"].sentence
    assert "drift" not in check(frames())["it clock"].sentence


@pytest.mark.parametrize(
    ("yaw", "estimates", "level", "text"),
    [
        ("measured", estimator(attitude=False, position=False), Level.WARNING, "normal without compass"),
        ("measured", estimator(attitude=False, ratio=1.6), Level.FAIL, "rejects velocity"),
        ("none", estimator(attitude=False), Level.FAIL, "no attitude yet"),
        ("none", estimator(constant=True), Level.OK, "attitude and position good"),
        ("none", estimator(position=False), Level.WARNING, "no position"),
    ],
)
def test_what_the_estimator_of_px4_reports_before_poses(yaw, estimates, level, text):
    link = Autopilot(connection="udpin:127.0.0.1:0", profile="px4", yaw=yaw)
    result = _estimate("it", link, [estimates])
    assert (result.level, text in result.sentence) == (level, True)


@pytest.mark.parametrize(
    ("state", "level"),
    [
        (OriginState.CONFIRMED, Level.OK),
        (OriginState.PRESENT, Level.OK),
        (OriginState.UNSUPPORTED, Level.WARNING),
        (OriginState.SENT, Level.FAIL),
        (None, Level.FAIL),
    ],
)
def test_a_configured_origin_must_be_confirmed(monkeypatch, state, level):
    monkeypatch.setattr(Autopilot, "origin", state)
    link = Autopilot(global_origin={"latitude_deg": 1, "longitude_deg": 2, "altitude_m": 3})
    found = {v.name: v for v in autopilot_checks(observe(link, frames()), [STATUS], ESTIMATORS)}
    assert found["it origin"].level is level


@pytest.mark.parametrize(("profile", "hint"), [("ardupilot", "ATTITUDE: SRn_EXTRA1"), ("px4", "MAV_n_MODE 2")])
def test_a_missing_message_names_the_stream_that_it_comes_in(profile, hint):
    link = Autopilot(profile=profile)
    autopilot = 3 if profile == "ardupilot" else 12
    records = frames(attitude_hz=0, autopilot=autopilot)
    found = {v.name: v for v in autopilot_checks(observe(link, records), [STATUS], ESTIMATORS)}
    assert hint in found["it rates"].sentence
