"""The outcome of a flight: errors of sent poses, wrong ones, crashes, and the scatter of a hover."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flow.link import Record
from links.mavlink.ned_frd import R_odom_drone_from_wxyz, wxyz_from_R_odom_drone
from links.mavlink.poses.sent_frame import SentFrame
from links.simulated.autopilot.flight_stack.outcomes.outcome import FlightOutcome
from links.simulated.sensors.vehicle_odometry import VehicleOdometry, VehicleOdometrySettings
from links.simulated.world.mesh import RayScene, box
from links.simulated.world.scene import Truth
from stages.geometry.frames import rotation_z
from tests.links.simulated.autopilot.flight_stack.sent_truth import PARKED, START_NS, Host

MAP = SentFrame(0.0, np.zeros(3))


def watched(host: Host, world: RayScene | None = None, odometry: VehicleOdometry | None = None) -> FlightOutcome:
    scene = world or RayScene(box((-500, -500, -500), (-499, -499, -499), "metal"))
    return FlightOutcome(host.stack, scene, Truth(START_NS, PARKED, host.stack.motion), odometry)


def sent(host: Host, outcome: FlightOutcome, shift_m: float = 0.0, yaw_deg: float = 0.0) -> None:
    """One pose that is wrong by so much, forward and in yaw."""
    half = math.radians(-yaw_deg) / 2  # NED

    def change(message, time_s: float) -> None:
        message.x += shift_m
        w, x, y, z = message.q
        c, s = math.cos(half), math.sin(half)
        message.q = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]

    host.edit = change
    now_ns = START_NS + host.ticks * 10_000_000
    frame = bytes(host.pose(now_ns).pack(host._mav))
    outcome.on_sent(Record("/autopilot/tx", now_ns, now_ns, frame), MAP)


@pytest.mark.parametrize(("shift_m", "yaw_deg", "wrong"), [(0.0, 0.0, 0), (1.5, 0.0, 1), (0.0, 15.0, 1), (0.7, 8.0, 0)])
def test_a_pose_is_wrong_above_one_metre_or_ten_degrees(shift_m: float, yaw_deg: float, wrong: int) -> None:
    host = Host(3.0)
    outcome = watched(host)
    host.run(2.0)
    sent(host, outcome, shift_m, yaw_deg)
    result = outcome.result()
    assert (result.sent_poses, result.wrong_poses) == (1, wrong)
    assert result.sent_worst_m == pytest.approx(shift_m, abs=0.2)
    assert result.sent_yaw_worst_deg == pytest.approx(yaw_deg, abs=1.0)


def test_a_pose_of_a_time_that_was_not_flown_does_not_count() -> None:
    host = Host(3.0)
    outcome = watched(host)
    host.run(2.0)
    sent(host, outcome)
    before = outcome.result()
    host.edit = lambda message, time_s: setattr(message, "time_usec", message.time_usec + 400_000)
    now_ns = START_NS + host.ticks * 10_000_000
    outcome.on_sent(Record("/autopilot/tx", now_ns, now_ns, bytes(host.pose(now_ns).pack(host._mav))), MAP)
    assert outcome.result() == before


def test_a_drift_of_the_vehicles_odometry_is_no_error_of_the_pose() -> None:
    class Shifted(VehicleOdometry):
        def T_map_vehicle(self, stamp_ns):
            return np.tile(np.eye(3), (len(stamp_ns), 1, 1)), np.tile([1.5, 0.0, 0.0], (len(stamp_ns), 1))

    host = Host(3.0)
    outcome = watched(host, odometry=Shifted(VehicleOdometrySettings(), PARKED, START_NS, 3.0, seed=1))
    host.run(2.0)
    sent(host, outcome, shift_m=1.5)
    assert outcome.result().sent_worst_m == pytest.approx(0.0, abs=0.2)


@pytest.mark.parametrize(("shift_m", "yaw_deg", "inside"), [(0.0, 0.0, (1, 1)), (0.5, 0.0, (0, 1)), (0.0, 6.0, (1, 0))])
def test_the_share_inside_is_that_of_the_covariance_in_the_message(
    shift_m: float, yaw_deg: float, inside: tuple[int, int]
) -> None:
    """One sigma is 0.1 m and 1.1 deg, in `Host.pose`."""
    host = Host(3.0)
    outcome = watched(host)
    host.run(2.0)
    sent(host, outcome, shift_m, yaw_deg)
    result = outcome.result()
    assert (result.inside_share, result.yaw_inside_share) == inside


@pytest.mark.parametrize("has_yaw", [True, False])
@pytest.mark.parametrize(("stated_deg", "error_m"), [(30.0, 0.0), (0.0, 3.4)])
def test_a_pose_is_compared_in_the_frame_that_grd_states(has_yaw: bool, stated_deg: float, error_m: float) -> None:
    """The drone is 6 to 7 m from the origin: 30 deg move it by 3.1 to 3.6 m."""
    host = Host(3.0)
    outcome = watched(host)
    host.run(2.0)

    def change(message, time_s: float) -> None:
        R = rotation_z(math.radians(-30.0))
        x, y, _ = R @ [message.x, -message.y, 0.0]
        message.x, message.y = float(x) + 40.0, float(-y)
        turned = wxyz_from_R_odom_drone(R @ R_odom_drone_from_wxyz(message.q))
        message.q = turned if has_yaw else [math.nan] * 4

    host.edit = change
    now_ns = START_NS + host.ticks * 10_000_000
    frame = Record("/autopilot/tx", now_ns, now_ns, bytes(host.pose(now_ns).pack(host._mav)))
    outcome.on_sent(frame, SentFrame(math.radians(stated_deg), np.array([40.0, 0.0, 0.0])))
    result = outcome.result()
    assert result.sent_worst_m == pytest.approx(error_m, abs=0.4)
    assert result.sent_yaw_rms_deg == (pytest.approx(30.0 - stated_deg, abs=1.0) if has_yaw else None)


def test_the_longest_gap_lasts_from_one_pose_to_the_next_or_to_the_end() -> None:
    host = Host(6.0)
    outcome = watched(host)
    assert outcome.result().longest_gap_s is None
    host.run(1.0)
    sent(host, outcome)
    host.run(2.5)
    sent(host, outcome)
    assert outcome.result().longest_gap_s == pytest.approx(1.5, abs=0.02)
    host.run(6.0)
    assert outcome.result().longest_gap_s == pytest.approx(3.5, abs=0.02)


def test_flying_into_an_obstacle_is_a_crash() -> None:
    """A wall 2 m ahead of a drone that flies forward."""
    plan = [{"do": "go_to", "xyz_m": [14.0, 0.0, 10.0], "speed_mps": 3.0, "for_s": 20}]
    host = Host(10.0, plan=plan, source_sets=["gps"])
    outcome = watched(host, RayScene(box((9.0, -30.0, -2.0), (9.5, 30.0, 30.0), "metal")))
    over = False
    while host.time_s < 10.0 and not over:
        host.run(host.time_s + 0.02)
        over = outcome.is_over()
    result = outcome.result()
    assert result.crashed
    assert result.lost_s is not None
    assert str(result).startswith("flight: crashed at")


def test_the_scatter_is_that_of_the_holds_on_external_poses() -> None:
    host = Host(20.0, plan=[{"do": "hold", "for_s": 8}, {"do": "use_sources", "set": 2}, {"do": "hold", "for_s": 12}])
    outcome = watched(host)
    host.run(20.0)
    states = host.stack.motion.states
    held = states[round(11.0 * 400) :, 0:3]
    expected = np.sqrt(((held - held.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert outcome.result().hover_scatter_m == pytest.approx(expected, abs=0.005)
