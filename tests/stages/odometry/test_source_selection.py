"""Odometry while it is heard, the camera's motion while it is not: one path without a jump."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.geometry.frames import rotation_z, transform
from stages.messages import VehicleMotion
from stages.odometry.vehicle import VehicleMotionSelector

S = 1_000_000_000


def at(time_s):
    """T_world_vehicle of a steady bend: 3 m/s forward, 0.2 rad/s to the left."""
    yaw, radius = 0.2 * time_s, 15.0
    return transform(rotation_z(yaw), np.array([radius * math.sin(yaw), radius * (1 - math.cos(yaw)), 0.0]))


def word(time_s, T_source_world=None, sigma=0.0):
    """A source's word; its start frame is its own. `sigma`: metres and rad, each axis."""
    T = (np.eye(4) if T_source_world is None else T_source_world) @ at(time_s)
    covariance = None if sigma is None else sigma**2 * np.eye(6)
    return VehicleMotion(stamp_ns=round(time_s * S), xyz_map_m=T[:3, 3], R_map_vehicle=T[:3, :3], covariance=covariance)


ELSEWHERE = transform(rotation_z(2.0), np.array([40.0, -7.0, 1.0]))
ANEW = transform(rotation_z(-1.0), np.array([-3.0, 9.0, 0.0]))
FAR = transform(rotation_z(-1.0), np.array([-300.0, 90.0, 0.0]))


def told(choice, odometry=(), ego=()):
    """All that is told of words in order of their stamps; ego's come `late_s` after theirs, as pictures do."""
    words = [(m.stamp_ns, choice.on_odometry, m) for m in odometry]
    words += [(m.stamp_ns + S // 10, choice.on_ego, m) for m in ego]
    out = [hear(m) for _, hear, m in sorted(words, key=lambda w: w[0])]
    return [m for m in out if m is not None]


def off(motion, T_start_world):
    """Metres and rad between a motion and the truth."""
    T = T_start_world @ at(motion.stamp_ns / S)
    turned = motion.R_map_vehicle.T @ T[:3, :3]
    return np.linalg.norm(motion.xyz_map_m - T[:3, 3]), math.acos(min(1.0, (np.trace(turned) - 1) / 2))


def seconds(first, last, step):
    return np.arange(round((last - first) / step)) * step + first


def test_odometry_alone_is_passed_on_as_it_comes():
    words = [word(t, ELSEWHERE) for t in seconds(0, 1, 0.02)]
    out = told(VehicleMotionSelector(), odometry=words)
    assert [m.stamp_ns for m in out] == [m.stamp_ns for m in words]
    for m, w in zip(out, words, strict=True):
        np.testing.assert_allclose(m.xyz_map_m, w.xyz_map_m, atol=1e-12)
        np.testing.assert_allclose(m.R_map_vehicle, w.R_map_vehicle, atol=1e-12)
        np.testing.assert_allclose(m.covariance, w.covariance)
        check_arrays(m)


def test_the_camera_alone_is_passed_on():
    words = [word(t, ELSEWHERE) for t in seconds(0, 2, 0.2)]
    out = told(VehicleMotionSelector(), ego=words)
    assert len(out) == len(words)
    np.testing.assert_allclose(out[-1].xyz_map_m, words[-1].xyz_map_m, atol=1e-12)


def test_the_camera_is_not_heard_while_the_odometry_is():
    choice = VehicleMotionSelector()
    out = told(choice, odometry=[word(t) for t in seconds(0, 2, 0.02)], ego=[word(t, ANEW) for t in seconds(0, 2, 0.2)])
    assert len(out) == 100
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-9


def test_odometry_that_goes_and_comes_back_elsewhere_leaves_one_path_in_its_first_frame():
    odometry = [word(t, ELSEWHERE) for t in seconds(0, 3, 0.02)] + [word(t, ANEW) for t in seconds(6, 9, 0.02)]
    ego = [word(t) for t in seconds(3.3, 6.0, 0.2)]
    out = told(VehicleMotionSelector(), odometry, ego)
    stamps = np.array([m.stamp_ns for m in out]) / S
    assert ((stamps > 3.2) & (stamps < 6.0)).sum() == len(ego) - 1  # the last one is heard when the odometry is back
    assert np.diff(stamps).max() < 0.5
    errors = np.array([off(m, ELSEWHERE) for m in out])
    assert errors[:, 0].max() < 1e-3  # two changes: an even motion is carried on over both gaps
    assert errors[:, 1].max() < 1e-3


def test_the_camera_first_then_odometry_keeps_the_cameras_frame():
    out = told(
        VehicleMotionSelector(),
        odometry=[word(t, ANEW) for t in seconds(2.05, 3, 0.02)],
        ego=[word(t, ELSEWHERE) for t in seconds(0, 2, 0.2)],
    )
    errors = np.array([off(m, ELSEWHERE) for m in out])
    assert errors[:, 0].max() < 1e-3
    assert out[-1].stamp_ns > 2.9 * S


@pytest.mark.parametrize("gap_s", [0.0, 0.2, 2.0])
@pytest.mark.parametrize("port", ["odometry", "ego"])
def test_a_source_whose_own_frame_jumps_leaves_one_path(port, gap_s):
    step_s = 0.02 if port == "odometry" else 0.2
    words = [word(t, ELSEWHERE) for t in seconds(0, 3, step_s)]
    words += [word(t, FAR) for t in seconds(3 + gap_s, 8, step_s)]
    out = told(VehicleMotionSelector(), **{port: words})
    errors = np.array([off(m, ELSEWHERE) for m in out])
    assert errors[:, 0].max() < (5.0 if gap_s == 2.0 else 1e-3)  # after a second nobody knows where it went
    assert errors[:, 1].max() < (0.5 if gap_s == 2.0 else 1e-3)
    assert len(words) - len(out) == 2  # are left out
    assert max(np.linalg.norm(b.xyz_map_m - a.xyz_map_m) for a, b in pairwise(out)) < 4.5


def test_an_uncertain_join_makes_its_words_less_sure():
    choice = VehicleMotionSelector()
    words = [word(t, sigma=0.01) for t in seconds(0, 1, 0.02)] + [word(t, ANEW, 0.01) for t in seconds(1.4, 2, 0.02)]
    out = told(choice, odometry=words)
    place_m = math.hypot(0.01, 0.5 * 3.0 * (1.4 - 0.98) ** 2)
    assert math.sqrt(out[50].covariance[5, 5]) == pytest.approx(place_m, rel=1e-3)


def test_a_false_word_is_left_out():
    words = [word(t, ANEW if 40 <= k < 42 else None) for k, t in enumerate(seconds(0, 2, 0.02))]
    out = told(VehicleMotionSelector(), odometry=words)
    assert len(out) == len(words) - 2
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-9


def nonsense(times, seed=0, spread_m=30.0):
    """Words of an odometry that has gone mad: anywhere, turned anyhow."""
    rng = np.random.default_rng(seed)
    return [
        word(t, transform(rotation_z(rng.uniform(-3, 3)), np.append(rng.uniform(-spread_m, spread_m, 2), 0.0)))
        for t in times
    ]


def test_the_camera_goes_on_while_the_odometry_tells_nonsense_and_what_is_left_out_is_counted():
    choice = VehicleMotionSelector()
    mad, ego = nonsense(seconds(2, 6, 0.02)), [word(t, ELSEWHERE) for t in seconds(2.4, 6, 0.2)]
    out = told(choice, [word(t) for t in seconds(0, 2, 0.02)] + mad, ego)
    assert np.diff([m.stamp_ns for m in out]).max() < 0.5 * S
    assert [m.stamp_ns for m in out[100:]] == [m.stamp_ns for m in ego]
    assert max(off(m, np.eye(4))[0] for m in out) < 1e-3
    assert choice.refused == {"odometry: not where the words before lead": len(mad)}
    back = [choice.on_odometry(word(t, ANEW)) for t in (6.0, 6.02, 6.04, 6.06)]
    assert [m is None for m in back] == [True, True, False, False]  # three that agree
    assert off(back[-1], np.eye(4))[0] < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_nonsense_is_not_believed_however_long_it_lasts_where_no_camera_tells(seed):
    choice = VehicleMotionSelector()
    out = told(choice, [word(t) for t in seconds(0, 2, 0.02)] + nonsense(seconds(2, 12, 0.02), seed))
    assert len(out) == 100
    sane = [choice.on_odometry(word(t)) for t in seconds(12, 13, 0.02)]
    assert max(off(m, np.eye(4))[0] for m in sane if m is not None) < 1e-9  # in the frame of before
    assert sum(m is None for m in sane) == 2


def test_a_fast_vehicles_odometry_that_was_silent_is_not_taken_for_one_that_jumped():
    times = [*seconds(0, 1, 0.02), *seconds(3, 4, 0.02)]
    words = [dataclasses.replace(word(t), xyz_map_m=np.array([30 * t, 0, 0]), R_map_vehicle=np.eye(3)) for t in times]
    out = told(VehicleMotionSelector(), odometry=words)
    assert [m.xyz_map_m[0] for m in out] == pytest.approx([30 * t for t in times])


def test_what_is_not_newer_than_what_was_told_is_left_out():
    choice = VehicleMotionSelector()
    assert choice.on_odometry(word(1.0)) is not None
    assert choice.on_odometry(word(1.0)) is None
    assert choice.on_odometry(word(0.9)) is None
    assert choice.on_ego(word(0.95)) is None


def test_uncertainty_grows_over_a_gap_and_then_as_the_new_source_says():
    choice = VehicleMotionSelector()
    for t in seconds(0, 1, 0.02):
        choice.on_odometry(word(t, sigma=0.01))
    first = choice.on_ego(word(2.0, ANEW, sigma=0.5))
    there = word(2.0, ANEW)
    standing = dataclasses.replace(there, stamp_ns=2_200_000_000, covariance=0.6**2 * np.eye(6))
    second = choice.on_ego(standing)
    gap_s = 2.0 - 0.98
    place = math.hypot(0.01, 0.5 * 3.0 * gap_s**2)
    np.testing.assert_allclose(np.sqrt(np.diag(first.covariance))[3:], place, rtol=1e-6)
    np.testing.assert_allclose(second.covariance, first.covariance + (0.6**2 - 0.5**2) * np.eye(6), atol=1e-9)


def test_a_source_that_does_not_say_how_sure_it_is_makes_nobody_sure():
    choice = VehicleMotionSelector()
    assert choice.on_odometry(word(0.0, sigma=None)).covariance is None
    assert choice.on_ego(word(1.0)).covariance is None
    assert choice.on_odometry(word(1.1, sigma=0.1)).covariance is None


def test_its_ports_are_the_two_sources_and_one_motion():
    assert set(input_ports(VehicleMotionSelector)) == {"odometry", "ego"}
    assert set(output_ports(VehicleMotionSelector)) == {"vehicle_motion"}
    with pytest.raises(ValidationError):
        VehicleMotionSelector(silent_s=0.0)
