"""SweepVibrateAim: angles at which the scan plane contains the drone, and the servo's goals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from stages.aim.vibrate import (
    SweepVibrateAim,
    nearest_within,
    plane_angles_rad,
    servo_angles_rad,
    vibration_ends_rad,
)
from stages.geometry.frames import Harmonic, LidarMount, Pose, rotation_z
from stages.messages import Detections, DroneFix, KernelScores, ServoGoal, ServoState, TrackingState, TrackState

ON_ITS_SIDE = Pose(xyz_m=(0.0, 0.0, 0.10), rpy_deg=(90.0, 0.0, 0.0))
MOUNT = LidarMount(T_vehicle_turntable=Pose(xyz_m=(0.0, 0.0, 0.25)), T_turntable_lidar=ON_ITS_SIDE)
RPM = math.tau / 60


def aim(**settings) -> SweepVibrateAim:
    return SweepVibrateAim(**{"mount": MOUNT} | settings)


def servo(position_deg: float, t_s: float = 0.0) -> ServoState:
    return ServoState(
        stamp_ns=round(t_s * 1e9), position_rad=math.radians(position_deg), velocity_radps=0.0, goal_rad=0.0, error=0
    )


def fix(x: float, y: float, z: float) -> DroneFix:
    return DroneFix(stamp_ns=0, xyz_vehicle_m=np.array([x, y, z]), covariance_m2=np.eye(3), hits=3)


def state(which: TrackingState) -> TrackState:
    return TrackState(stamp_ns=0, state=which, reason="", hits=0, frame_s=0.12)


def detections(*xyz: tuple[float, float, float], accepted: tuple[bool, ...]) -> Detections:
    n = len(xyz)
    return Detections(
        stamp_ns=0,
        xyz_vehicle_m=np.array(xyz, dtype=np.float64).reshape(-1, 3),
        evidence=KernelScores(e_inner=np.zeros(n), e_outer=np.zeros(n)),
        accepted=np.array(accepted, dtype=np.bool_),
        reasons=("",) * n,
        summary="",
    )


def at_azimuth(deg: float, up_m: float = 10.0) -> tuple[float, float, float]:
    return 10 * math.cos(math.radians(deg)), 10 * math.sin(math.radians(deg)), up_m


def tracking(stage: SweepVibrateAim, azimuth_deg: float) -> None:
    stage.on_fix(fix(*at_azimuth(azimuth_deg)))
    stage.on_state(state(TrackingState.TRACKING))


class Rig:
    """A stage and a servo without latency, of at most 55 rpm."""

    def __init__(self, start_deg: float, **settings) -> None:
        self.stage = aim(**settings)
        self.position, self.goal, self.speed, self.t_s = start_deg, start_deg, 0.0, 0.0

    def run(self, seconds: float) -> np.ndarray:
        """Positions [deg] at 200 Hz."""
        trace = []
        for _ in range(round(seconds / 0.005)):
            goal = self.stage.on_servo(servo(self.position, self.t_s))
            if goal is not None:
                self.goal, self.speed = math.degrees(goal.position_rad), min(math.degrees(goal.speed_radps), 330.0)
            self.position += min(max(self.goal - self.position, -self.speed * 0.005), self.speed * 0.005)
            self.t_s += 0.005
            trace.append(self.position)
        return np.array(trace)


def test_a_plane_through_the_axis_contains_a_point_at_its_azimuth_and_opposite() -> None:
    angles = plane_angles_rad(ON_ITS_SIDE.matrix(), np.array([3.0, 4.0, 7.0]))
    azimuth = math.atan2(4.0, 3.0)
    assert sorted(angles) == pytest.approx([azimuth, azimuth + math.pi])


@given(
    st.tuples(*[st.floats(-30, 30)] * 3),
    st.tuples(st.floats(70, 110), st.floats(-15, 15), st.floats(-180, 180)),
    st.floats(-0.2, 0.2),
)
def test_the_turned_plane_contains_the_point(xyz, rpy_deg, offset_m) -> None:
    T = Pose(xyz_m=(offset_m, -0.03, 0.1), rpy_deg=rpy_deg).matrix()
    p = np.array(xyz)
    n, o = T[:3, 2], T[:3, 3]
    reach = math.hypot(n[0], n[1]) * math.hypot(p[0], p[1])
    if reach < 1e-6 or abs(n @ o - n[2] * p[2]) > reach:
        return  # no solution
    for theta in plane_angles_rad(T, p):
        assert n @ (rotation_z(-theta) @ p - o) == pytest.approx(0.0, abs=1e-6)


def test_without_a_solution_the_nearest_angle_is_returned_and_on_the_axis_none() -> None:
    tilted = Pose(
        rpy_deg=(60.0, 0.0, 0.0)
    ).matrix()  # the plane is tilted by 30 deg: it never contains a point near the zenith
    a, b = plane_angles_rad(tilted, np.array([1.0, 0.0, 20.0]))
    distances = [abs(tilted[:3, 2] @ (rotation_z(-t) @ [1.0, 0.0, 20.0])) for t in np.linspace(0, math.tau, 721)]
    assert a == pytest.approx(b)
    assert abs(tilted[:3, 2] @ (rotation_z(-a) @ [1.0, 0.0, 20.0])) == pytest.approx(min(distances), abs=1e-4)
    assert plane_angles_rad(ON_ITS_SIDE.matrix(), np.array([0.0, 0.0, 20.0])) == ()


def test_servo_positions_invert_sign_zero_and_encoder_error() -> None:
    mount = LidarMount(
        T_vehicle_turntable=Pose(xyz_m=(0.2, 0.1, 0.25), rpy_deg=(0.0, 0.0, 30.0)),
        T_turntable_lidar=ON_ITS_SIDE,
        servo_sign=-1,
        servo_zero_deg=12.0,
        servo_harmonics=(Harmonic(order=1, amplitude_deg=2.0, phase_deg=40.0),),
    )
    drone = np.array([5.0, 8.0, 12.0])
    T = mount.T_vehicle_turntable.matrix()
    p = T[:3, :3].T @ (drone - T[:3, 3])
    for position in servo_angles_rad(mount, drone):
        theta = mount.turntable_rad(np.array([position]))[0]
        assert ON_ITS_SIDE.matrix()[:3, 2] @ (rotation_z(-theta) @ p) == pytest.approx(0.0, abs=1e-6)


def test_the_servo_position_is_invariant_to_a_common_rotation() -> None:
    turned = MOUNT.model_copy(update={"T_vehicle_turntable": Pose(xyz_m=(0.0, 0.0, 0.25), rpy_deg=(0.0, 0.0, 77.0))})
    drone = np.array([3.0, -6.0, 9.0])
    there = servo_angles_rad(turned, rotation_z(math.radians(77.0)) @ drone)
    np.testing.assert_allclose(np.mod(there, math.tau), np.mod(servo_angles_rad(MOUNT, drone), math.tau), atol=1e-9)


def test_the_angle_within_the_travel_is_used_and_of_two_the_nearer() -> None:
    travel, deg = (0.0, math.pi), math.radians
    assert nearest_within((deg(-60), deg(120), deg(300)), deg(0), travel, 0.0) == deg(120)
    assert nearest_within((deg(0.0), deg(180.0)), deg(170), travel, 0.0) == deg(180)
    assert nearest_within((deg(-4), deg(176)), deg(2), travel, 0.0) == deg(176)
    assert nearest_within((deg(-4), deg(176)), deg(2), travel, deg(5)) == deg(-4)
    assert nearest_within((deg(-6), deg(174)), deg(2), travel, deg(5)) == deg(174)
    assert nearest_within((), deg(33), travel, 0.0) == deg(33)


def test_the_vibration_stays_within_the_travel() -> None:
    assert vibration_ends_rad(1.0, 0.1, (0.0, 3.0)) == pytest.approx((0.9, 1.1))
    assert vibration_ends_rad(0.02, 0.1, (0.0, 3.0)) == pytest.approx((0.0, 0.2))
    assert vibration_ends_rad(-0.05, 0.1, (0.0, 3.0)) == pytest.approx((0.0, 0.2))
    assert vibration_ends_rad(2.99, 0.1, (0.0, 3.0)) == pytest.approx((2.8, 3.0))


def test_without_a_track_it_sweeps_forth_and_back_at_11_4_rpm() -> None:
    stage = aim()
    goal = stage.on_servo(servo(0.0))
    assert isinstance(goal, ServoGoal)
    assert goal.position_rad == pytest.approx(math.pi)
    assert goal.speed_radps == pytest.approx(11.4 * RPM)
    assert stage.on_servo(servo(90.0, 1.0)) is None
    back = stage.on_servo(servo(179.6, 2.0))
    assert back is not None
    assert back.position_rad == 0.0
    assert stage.on_servo(servo(100.0, 3.0)) is None


def test_a_sweep_starts_with_the_nearer_end() -> None:
    goal = aim().on_servo(servo(150.0))
    assert goal is not None
    assert goal.position_rad == pytest.approx(math.pi)


def test_tracking_vibrates_five_degrees_about_the_drones_azimuth_at_57_2_rpm() -> None:
    rig = Rig(0.0)
    rig.run(0.3)
    tracking(rig.stage, 60.0)
    goal = rig.stage.on_servo(servo(20.0, 0.3))
    assert goal is not None
    assert math.degrees(goal.position_rad) == pytest.approx(55.0)
    assert goal.speed_radps == pytest.approx(57.2 * RPM)
    rig = Rig(55.0)
    tracking(rig.stage, 60.0)
    positions = rig.run(1.0)[20:]
    assert positions.max() == pytest.approx(65.0, abs=0.51)
    assert positions.min() == pytest.approx(55.0, abs=0.51)


def test_the_vibration_follows_a_moving_drone() -> None:
    rig = Rig(55.0)
    tracking(rig.stage, 60.0)
    rig.run(0.5)
    tracking(rig.stage, 80.0)
    assert rig.run(0.6)[40:].mean() == pytest.approx(80.0, abs=1.0)


def test_a_drone_behind_is_observed_with_the_opposite_side_of_the_plane() -> None:
    stage = aim()
    tracking(stage, -120.0)
    goal = stage.on_servo(servo(0.0))
    assert goal is not None
    assert math.degrees(goal.position_rad) == pytest.approx(55.0)


def test_at_the_end_of_the_travel_it_stays_while_the_drone_is_within_the_slack() -> None:
    rig = Rig(5.0)
    tracking(rig.stage, 3.0)
    near = rig.run(0.5)
    assert near.min() > -0.1
    assert near.max() < 10.1
    tracking(rig.stage, -4.0)
    assert rig.run(0.5).max() < 10.1
    tracking(rig.stage, -8.0)
    assert rig.run(1.5)[-1] == pytest.approx(172.0, abs=5.1)


def test_after_a_loss_it_sweeps() -> None:
    for gone in (TrackingState.LOST, TrackingState.SEARCHING):
        rig = Rig(55.0)
        tracking(rig.stage, 60.0)
        rig.run(0.3)
        rig.stage.on_state(state(gone))
        goal = rig.stage.on_servo(servo(60.0, 0.3))
        assert goal is not None
        assert goal.position_rad == 0.0
        assert goal.speed_radps == pytest.approx(11.4 * RPM)


def test_before_the_first_fix_it_aims_at_the_best_accepted_detection() -> None:
    rig = Rig(0.0)
    rig.stage.on_detections(detections(at_azimuth(20.0), at_azimuth(90.0), accepted=(False, True)))
    rig.stage.on_state(state(TrackingState.TRACKING))
    assert rig.run(1.0)[100:].mean() == pytest.approx(90.0, abs=1.0)
    tracking(rig.stage, 40.0)
    rig.stage.on_detections(detections(at_azimuth(150.0), accepted=(True,)))  # a fix has priority
    assert rig.run(1.0)[100:].mean() == pytest.approx(40.0, abs=1.0)


def test_without_a_position_it_continues_the_sweep_and_rejected_detections_give_none() -> None:
    stage = aim()
    first = stage.on_servo(servo(0.0))
    stage.on_detections(detections(at_azimuth(20.0), accepted=(False,)))
    stage.on_detections(detections(accepted=()))
    stage.on_state(state(TrackingState.TRACKING))
    assert first is not None
    assert stage.on_servo(servo(50.0, 1.0)) is None


def test_for_a_drone_on_the_axis_it_vibrates_about_the_servos_position() -> None:
    rig = Rig(100.0)
    rig.stage.on_fix(fix(0.0, 0.0, 20.0))
    rig.stage.on_state(state(TrackingState.TRACKING))
    assert rig.run(0.6)[40:].mean() == pytest.approx(100.0, abs=1.0)


def test_a_stalled_servo_is_reversed_after_the_stall_time() -> None:
    stage = aim(stall_s=0.3)
    stage.on_servo(servo(0.0, 0.0))
    assert stage.on_servo(servo(100.0, 1.0)) is None
    assert stage.on_servo(servo(100.0, 1.25)) is None
    goal = stage.on_servo(servo(100.0, 1.31))
    assert goal is not None
    assert goal.position_rad == 0.0


def test_a_lidar_that_does_not_turn_gets_no_goal() -> None:
    stage = aim(mount=LidarMount(turns=False))
    tracking(stage, 60.0)
    assert stage.on_servo(servo(0.0)) is None


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"travel_deg": (180.0, 0.0)}, "two increasing angles at least twice half_angle_deg apart"),
        ({"travel_deg": (80.0, 88.0)}, "two increasing angles at least twice half_angle_deg apart"),
        ({"half_angle_deg": 0}, "greater than 0"),
        ({"sweep_rpm": -1}, "greater than 0"),
    ],
)
def test_an_impossible_setting_is_an_error_when_it_is_built(wrong, text) -> None:
    with pytest.raises(ValidationError, match=text):
        aim(**wrong)
