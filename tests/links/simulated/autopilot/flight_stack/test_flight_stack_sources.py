"""The simulated autopilot flies on what it is sent, by the rules of ArduPilot and PX4."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.mavlink.poses.sent_frame import SentFrame
from links.simulated.autopilot.rules import PoseResult
from tests.links.simulated.autopilot.flight_stack.sent_truth import TO_EXTERNAL, Host


def test_on_gps_it_holds_within_the_error_of_the_gps() -> None:
    host = Host(20.0, source_sets=["gps"], plan=[{"do": "hold", "for_s": 20}])
    host.run(20.0)
    assert not host.stack.quadrotor.crashed
    assert np.linalg.norm(host.stack.quadrotor.state[0:2] - [7.0, 0.0]) < 4 * 0.8
    assert host.received("EKF_STATUS_REPORT")[-1].flags & (8 | 256) == 8 | 256


@pytest.mark.parametrize("sets", ["external", "external_no_velocity", "external_baro_height"])
@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_after_the_switch_it_hovers_on_what_it_is_sent(kind: str, sets: str) -> None:
    host = Host(16.0, kind=kind, source_sets=["gps", sets])
    host.run(16.0)
    assert host.scatter_m(8.0) < 0.35  # broadband vibration moves the estimated velocity
    assert "EKF failsafe" not in host.events()
    estimate = host.stack.ekf.output()
    np.testing.assert_allclose(estimate[0:2], host.stack.quadrotor.state[0:2], atol=0.2)  # map is the world here


@pytest.mark.parametrize("stated", [True, False])
def test_a_plan_on_external_poses_is_flown_in_the_axes_that_grd_states(stated: bool) -> None:
    """`Host` sends in the axes of map; without a statement they are taken as axes that point north, 57 deg off."""
    host = Host(16.0, plan=[*TO_EXTERNAL[:2], {"do": "go_to", "xyz_m": [11.0, 0.0, 10.0], "for_s": 12}])
    host.stack.sent_frame = SentFrame(0.0, np.zeros(3)) if stated else None
    host.run(16.0)
    away_m = float(np.linalg.norm(host.stack.quadrotor.state[0:3] - [11.0, 0.0, 10.0]))
    assert (away_m < 0.7) == stated


@pytest.mark.parametrize(("sets", "flies"), [(["gps", "external_position"], True), (["external_no_velocity"], False)])
def test_px4_takes_positions_without_rotation_only_with_a_compass(sets: list[str], flies: bool) -> None:
    plan = [
        {"do": "path", "for_s": 4},
        *([{"do": "use_sources", "set": 2}] if flies else []),
        {"do": "hold", "for_s": 60},
    ]
    host = Host(16.0, kind="px4", source_sets=sets, plan=plan, autopilot={"heading_of_world_x_deg": 0.0})

    def in_ned(message, time_s: float) -> None:
        message.frame_id, message.q = 1, [math.nan] * 4

    host.edit = in_ned
    host.run(16.0)
    fused = host.stack.ekf.input.results
    assert (fused[PoseResult.FUSED] > 400) == flies
    assert (fused[PoseResult.NOT_FINITE] > 400) != flies
    assert not flies or host.scatter_m(8.0) < 0.25


def test_a_wrong_position_moves_the_drone_the_other_way() -> None:
    """A position that is 1 m too far forward from 8 s on moves the drone back by 1 m."""
    host = Host(45.0)

    def shift(message, time_s: float) -> None:
        message.x += min(max(time_s - 8.0, 0.0) / 4.0, 1.0)

    host.edit = shift
    host.run(8.0)
    before = host.stack.quadrotor.state[0]
    host.run(45.0)
    assert host.stack.quadrotor.state[0] - before == pytest.approx(-1.0, abs=0.25)


def test_an_outlier_is_gated_and_a_new_reset_counter_is_taken_over() -> None:
    host = Host(12.0)
    host.run(10.0)
    before = host.stack.ekf.output()[0]

    def far(message, time_s: float) -> None:
        message.x += 8.0

    host.edit = far
    host.run(10.4)
    assert host.stack.ekf.primary.status.position > 1
    assert abs(host.stack.ekf.output()[0] - before) < 0.3

    def far_and_reset(message, time_s: float) -> None:
        message.x, message.reset_counter = message.x + 8.0, 2

    host.edit = far_and_reset
    host.run(10.9)
    assert host.stack.ekf.output()[0] - before == pytest.approx(8.0, abs=0.4)
    assert abs(host.stack.quadrotor.state[0] - 7.0) < 2.0  # the target has jumped with the estimate


@pytest.mark.parametrize(("kind", "after_s"), [("ardupilot", 8.2), ("px4", 6.2)])
def test_without_poses_it_lands_after_the_timeout_and_one_second(kind: str, after_s: float) -> None:
    """ArduPilot: 7 s (posRetryTimeNoVel_ms) and 1 s (ekf_check); PX4: 5 s (EKF2_NOAID_TOUT) and the same check."""
    host = Host(22.0, kind=kind)
    host.sends = lambda time_s: 1.0 < time_s < 8.0
    host.run(22.0)
    failsafe_s = next(event.time_s for event in host.stack.events if str(event) == "EKF failsafe")
    assert failsafe_s == pytest.approx(8.0 + after_s, abs=0.5)
    assert host.stack.quadrotor.state[2] < 7.0  # descends from 10 m
    assert host.received("HEARTBEAT")[-1].custom_mode == 9


def test_a_gap_of_five_seconds_is_survived() -> None:
    host = Host(20.0)
    host.sends = lambda time_s: time_s > 1.0 and not 9.0 < time_s < 14.0
    host.run(20.0)
    assert "EKF failsafe" not in host.events()
    assert np.linalg.norm(host.stack.quadrotor.state[0:2] - host.stack.motion.states[3600, 0:2]) < 1.5


@pytest.mark.parametrize("options", [0, 1])
def test_all_velocities_are_fused_with_bit_0_of_the_source_options(options: int) -> None:
    """On GPS, poses that are merely sent: with bit 0 their velocity is fused. Map is turned by 150 deg against north,
    so the loop of the velocity has the wrong sign: the flight is lost."""
    hold = [{"do": "hold", "for_s": 60}]
    host = Host(60.0, autopilot={"heading_of_world_x_deg": 150.0}, source_options=options, plan=hold)
    host.run(60.0)
    assert ("EKF failsafe" in host.events()) == bool(options)


def test_the_yaw_is_that_of_the_source_in_use() -> None:
    """On the compass (30 deg wrong) the estimate is 30 deg off the true yaw by north; on poses it is that of map."""
    host = Host(12.0, compass={"offset_deg": 30, "hard_iron_ut": 0.0, "motor_ut": 0.0, "slow_ut": 0.0})
    host.run(3.9)
    assert yaw_error_deg(host, north=True) == pytest.approx(30.0, abs=6.0)  # the GPS pulls it a little
    host.run(12.0)
    assert yaw_error_deg(host, north=False) == pytest.approx(0.0, abs=3.0)


def yaw_error_deg(host: Host, *, north: bool) -> float:
    """Estimated yaw less the true one, in the north-aligned frame or in map."""
    x, y, z, w = host.stack.quadrotor.state[6:10]
    true = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)) - math.radians(57.0 if north else 0.0)
    return math.degrees(math.remainder(host.stack.ekf.primary.lane.yaw_rad - true, math.tau))


def test_a_jump_of_the_estimate_is_reported_and_flown_back() -> None:
    host = Host(24.0, estimate_resets_m=[(10.0, (0.5, 0.0, 0.0))])
    host.run(9.9)
    before = host.received("ODOMETRY")[-1]
    host.run(10.6)
    after = host.received("ODOMETRY")[-1]
    assert after.reset_counter != before.reset_counter
    host.run(24.0)
    assert host.scatter_m(18.0) < 0.2
    assert "EKF reset" in host.events()


def test_a_second_lane_takes_over_by_its_score() -> None:
    host = Host(10.0, lanes=2)
    host.run(9.0)
    first = host.stack.ekf.primary
    first.status.position = 4.0
    assert host.stack.ekf.switch_lane() == 1
    assert host.stack.ekf.primary is not first
    host.run(10.0)
    assert not host.stack.quadrotor.crashed


def test_the_same_seed_gives_the_same_bytes() -> None:
    a, b, c = Host(2.0), Host(2.0), Host(2.0, seed=2)
    for host in (a, b, c):
        host.run(2.0)
    frames = [[m.get_msgbuf() for _, m in host.frames] for host in (a, b, c)]
    assert frames[0] == frames[1]
    assert frames[0] != frames[2]
