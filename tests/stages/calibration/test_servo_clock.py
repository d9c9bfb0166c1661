"""The servo's clock against the LiDAR's, on a simulated recording with shifted servo stamps."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from flow.message import check_arrays
from links.dynamixel import Servo
from links.lidar import Lidar
from links.recording import RecordingReader
from stages.calibration.servo_clock import ServoClock, both_ways_rad
from stages.calibration.servo_mount import servo_mount
from stages.geometry.frames import LidarMount
from stages.messages import LidarFirings, VehicleMotion
from tests.stages.calibration.made_sweep import RIG, SLOW, sweep
from tests.stages.made import servo

RECORDING = Path(__file__).resolve().parents[3] / "recordings" / "street_sweep.mcap"
VIBRATING_S = 2.65  # a sweep one way, then vibration
WINDOW_S = 2.3


@pytest.fixture(scope="module")
def recorded():
    """(mount, messages in the order of arrival): a parked vehicle, no error of the rig."""
    lidar, servo = Lidar(), Servo()
    with RecordingReader(RECORDING) as reader:
        mount = LidarMount(**yaml.safe_load(reader.rig_yaml)["lidar"]["mount"])
        records = reader.records({"/lidar/packets", "/servo/state"})
        messages = [(lidar if r.topic == lidar.topic else servo).decode(r) for r in records]
    return mount, [m for m in messages if m is not None]


def outputs_of(recorded, late_s=0.0, from_s=VIBRATING_S, to_s=9.0, motion=(), **settings):
    """Outputs of the stage when the servo's stamps are late by `late_s`."""
    mount, messages = recorded
    stage = ServoClock(mount=settings.pop("mount", mount), window_s=WINDOW_S, **settings)
    for message in motion:
        stage.on_motion(message)
    outputs, start_ns = [], messages[0].stamp_ns
    for message in messages:
        if not from_s * 1e9 <= message.stamp_ns - start_ns < to_s * 1e9:
            continue
        if isinstance(message, LidarFirings):
            outputs += stage.on_firings(message)
        else:
            stage.on_servo(dataclasses.replace(message, stamp_ns=message.stamp_ns + round(late_s * 1e9)))
    return outputs


@pytest.mark.parametrize("late_s", [-2e-3, 0.0, 5e-4])
def test_late_stamps_are_estimated_with_a_consistent_sigma(recorded, late_s):
    (offset,) = outputs_of(recorded, late_s)
    check_arrays(offset)
    assert offset.sigma_s < 4e-4
    assert abs(offset.offset_s + late_s) < 3 * offset.sigma_s
    assert (offset.windows, offset.rig_offset_s) == (1, 0.0)
    assert "this window alone" in offset.reason


def test_the_rigs_offset_is_included(recorded):
    mount = recorded[0].model_copy(update={"servo_time_offset_s": 1e-3})
    (offset,) = outputs_of(recorded, late_s=-1e-3, mount=mount)
    assert offset.rig_offset_s == 1e-3
    assert abs(offset.offset_s - 1e-3) < 3 * offset.sigma_s


def test_a_sweep_in_one_direction_gives_no_estimate(recorded):
    (offset,) = outputs_of(recorded, late_s=1e-3, from_s=0.1, to_s=2.6)
    assert (offset.offset_s, offset.sigma_s, offset.windows) == (None, None, 0)
    assert "in both directions" in offset.reason


def driven(x_m):
    return VehicleMotion(stamp_ns=0, xyz_map_m=np.array([x_m, 0.0, 0.0]), R_map_vehicle=np.eye(3), covariance=None)


def test_a_moving_vehicle_gives_no_estimate(recorded):
    (offset,) = outputs_of(recorded, motion=[driven(0.0), driven(0.1)])
    assert (offset.offset_s, offset.reason) == (None, "the vehicle moved")
    (offset,) = outputs_of(recorded, motion=[driven(0.0), driven(0.01)])
    assert offset.offset_s is not None


def test_a_fixed_lidar_gives_no_estimate(recorded):
    assert outputs_of(recorded, mount=recorded[0].model_copy(update={"turns": False})) == []


def test_windows_are_combined_except_outliers():
    stage = ServoClock(mount=LidarMount())
    stage._firings = [LidarFirings.__new__(LidarFirings)]
    object.__setattr__(stage._firings[0], "stamp_ns", 0)
    stage._add(1e-3, 2e-4, 0.0)
    assert "alone: 1.20 ms, sigma 0.20 ms" in stage._add(1.2e-3, 2e-4, 0.0)
    first = stage._estimate(0, "")
    assert first.offset_s == pytest.approx(1.1e-3, rel=1e-3)
    assert first.sigma_s == pytest.approx(math.hypot(2e-4 / math.sqrt(2), 3e-4), rel=1e-3)
    assert "disagrees: 9.00 ms" in stage._add(9e-3, 2e-4, 0.0)
    doubtful = stage._estimate(0, "")
    assert doubtful.offset_s == first.offset_s
    assert doubtful.sigma_s > 4 * first.sigma_s


def test_the_common_sigma_does_not_decrease_with_the_number_of_windows():
    stage = ServoClock(mount=LidarMount())
    stage._firings = [LidarFirings.__new__(LidarFirings)]
    object.__setattr__(stage._firings[0], "stamp_ns", 0)
    for _ in range(100):
        result = stage._add(1e-3, 2e-4, 3e-4)
    assert "sigma 0.36 ms" in result
    assert stage._estimate(0, "").sigma_s == pytest.approx(math.hypot(2e-5, 3e-4, 3e-4), rel=1e-3)
    assert "alone" in stage._add(2.5e-3, 2e-4, 3e-4)  # a window may deviate by its own error only


def test_unknown_play_is_in_the_common_sigma():
    """Half of 0.1 deg of play at 68 deg/s is 0.7 ms, in both directions of each sweep."""
    true = replace(servo_mount(RIG), play_rad=math.radians(0.1))
    made = sweep(true, legs=((30.0, 150.0, SLOW), (150.0, 30.0, SLOW)), count=20_000)
    returns, stage = made.returns, ServoClock(mount=RIG)
    range_m = np.linalg.norm(returns.xyz_lidar_m, axis=1)
    seen = {"pulse_stamp_ns": returns.stamp_ns, "laser": returns.laser, "xyz_lidar_m": returns.xyz_lidar_m}
    stage._firings = [SimpleNamespace(range_m=range_m, **seen)]
    offset_s, own_s, shared_s = stage._solve(made.trace)
    assert 4e-4 < abs(offset_s) < 1e-3
    assert own_s < shared_s
    assert shared_s == pytest.approx(abs(offset_s) / 2, rel=0.2)  # play_sigma_deg is .05


def test_only_angles_passed_both_ways_count():
    stamp_ns = np.arange(200) * 5_000_000
    up = np.radians(np.linspace(0, 40, 100))
    down = np.radians(np.linspace(40, 30, 100))
    assert both_ways_rad(stamp_ns[:100], up) == 0
    assert math.degrees(both_ways_rad(stamp_ns, np.concatenate([up, down]))) == pytest.approx(10, abs=1)
    assert both_ways_rad(stamp_ns, np.full(200, 0.5)) == 0


def test_a_known_offset_skips_windows_and_ignores_their_data(recorded):
    later = [dataclasses.replace(m, stamp_ns=m.stamp_ns + 7_000_000_000) for m in recorded[1]]
    twice = recorded[0], [*recorded[1], *later]
    each = outputs_of(twice, to_s=20.0, every_window=1)
    stage_s = [(offset.stamp_ns - each[0].stamp_ns) * 1e-9 for offset in outputs_of(twice, to_s=20.0, every_window=3)]
    assert len(each) > 2
    assert len(stage_s) == 2
    assert stage_s[1] > 3 * WINDOW_S - 0.1
    moved = outputs_of(twice, to_s=20.0, every_window=3, motion=[driven(0.0), driven(0.1)])
    assert moved[0].reason == "the vehicle moved"
    assert moved[1].stamp_ns - moved[0].stamp_ns < 3e9  # the offset is unknown: no window is skipped


@pytest.mark.parametrize(
    "setting", [{"window_s": 0.1}, {"every_window": 0}, {"every_packet": 0}, {"floor_s": 0}, {"typo": 1}]
)
def test_impossible_clock_settings_are_errors(setting):
    with pytest.raises(ValidationError):
        ServoClock(mount=LidarMount(), **setting)


def test_buffers_are_bounded_without_lidar_data():
    clock = ServoClock(mount=LidarMount())
    for k in range(20_000):
        clock.on_servo(servo(k * 5_000_000, math.sin(0.01 * k)))
        clock.on_motion(driven(0.0))
    assert max(len(values) for values in vars(clock).values() if isinstance(values, list)) < 5000
