"""Prediction by odometry: estimated and unknown yaw, delayed messages, resets, and gaps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.messages import CandidateEvidence, Detections, DroneFix, DroneLocalPosition, TrackingState, TrackState
from stages.track import LikelihoodTrack
from stages.track.kalman import predicted
from stages.track.odometry_motion_model import NO_ODOMETRY_PRIOR, OdometryMotionModel, OdometrySample
from tests.stages.caster import Box, Drone, During, dithering, pulses_seen
from tests.stages.made import START_NS

YAW_RAD = 2.0  # of frame odom: its positions are Rz(-yaw) times those of frame map
RADIUS_M, RATE_RADPS = 4.0, 1.2


def at_ns(t_s):
    return START_NS + round(t_s * 1e9)


def circle(t_s):
    """Position and velocity (3,) on a horizontal circle, frame map."""
    c, s = math.cos(RATE_RADPS * t_s), math.sin(RATE_RADPS * t_s)
    return (
        np.array([RADIUS_M * c, 9.0 + RADIUS_M * s, 10.0]),
        RADIUS_M * RATE_RADPS * np.array([-s, c, 0.0]),
    )


def odometry(t_s, flown=circle, yaw_rad=YAW_RAD):
    """The same in frame odom."""
    position, velocity = flown(t_s)
    R_odom_raw = rotation_z(-yaw_rad)
    return R_odom_raw @ (position - flown(0.0)[0]), R_odom_raw @ velocity


def trained(seconds=4.0, seen=circle, flown=circle, yaw_rad=YAW_RAD):
    """A motion model after odometry and positions of this duration."""
    motion = OdometryMotionModel(0)
    for k in range(round(seconds / 0.02) + 1):
        t_s = 0.02 * k
        motion.telemetry.add(at_ns(t_s), *odometry(t_s, flown, yaw_rad))
        if k % 5 == 0 and k:
            motion.learn(1, at_ns(t_s), seen(t_s)[0], 0.1)
    return motion


def sample(t_s, source=0, resets=0):
    return OdometrySample(source, resets, *odometry(t_s))


def state(t_s):
    return np.concatenate(circle(t_s)), np.diag([0.01] * 3 + [0.04] * 3)


def test_with_an_estimated_yaw_the_prediction_follows_the_odometry():
    x, P = state(4.0)
    ahead, covariance = trained().predicted(x, P, 2.0, sample(4.0), sample(6.0), 1.0, 0.02)
    position, velocity = circle(6.0)
    # the yaw error is a degree or two, and the path deviates by 9 m from a straight line
    np.testing.assert_allclose(ahead[:3], position, atol=0.3)
    np.testing.assert_allclose(ahead[3:], velocity, atol=0.2)
    assert math.sqrt(covariance[0, 0]) < 0.7
    straight, _ = predicted(x, P, 2.0, 1.0)
    assert np.linalg.norm(straight[:3] - position) > 5.0


def test_the_prediction_does_not_depend_on_the_yaw_of_frame_odom():
    x, P = state(4.0)
    one = trained(yaw_rad=0.5)
    other = trained(yaw_rad=0.5 + math.pi / 2)  # whole steps of the grid: numerically the same
    a = one.predicted(
        x,
        P,
        1.0,
        OdometrySample(0, 0, *odometry(4.0, yaw_rad=0.5)),
        OdometrySample(0, 0, *odometry(5.0, yaw_rad=0.5)),
        1.0,
        0.02,
    )
    turned = 0.5 + math.pi / 2
    b = other.predicted(
        x,
        P,
        1.0,
        OdometrySample(0, 0, *odometry(4.0, yaw_rad=turned)),
        OdometrySample(0, 0, *odometry(5.0, yaw_rad=turned)),
        1.0,
        0.02,
    )
    np.testing.assert_allclose(a[0], b[0], atol=1e-6)
    np.testing.assert_allclose(a[1], b[1], atol=1e-6)


def test_an_unknown_yaw_gives_the_spread_of_all_directions():
    motion, (x, P) = OdometryMotionModel(0), state(0.0)
    before, after = sample(0.0), sample(1.0)
    ahead, covariance = motion.predicted(x, P, 1.0, before, after, 0.0, 0.0)
    plain, before_covariance = predicted(x, P, 1.0, 0.0)
    step = after.xyz_m - before.xyz_m - before.velocity_mps
    # for uniform psi, with probability 1 - NO_ODOMETRY_PRIOR: mean 0, variance |a|^2 / 2 on each horizontal axis
    np.testing.assert_allclose(ahead, plain, atol=1e-9)
    extra = covariance - before_covariance
    expected = 0.5 * (1.0 - NO_ODOMETRY_PRIOR) * float(step[:2] @ step[:2])
    np.testing.assert_allclose(np.diag(extra)[:2], expected, rtol=1e-9)
    np.testing.assert_allclose(extra[0, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diag(extra)[2], 0.0, atol=1e-12)


def test_the_covariance_is_that_of_the_weighted_yaws():
    motion = trained(0.8)  # a short path: several yaws fit
    x, P = state(0.8)
    before, after = sample(0.8), sample(2.3)
    ahead, covariance = motion.predicted(x, P, 1.5, before, after, 0.0, 0.0)
    plain, base = predicted(x, P, 1.5, 0.0)
    step = after.xyz_m - before.xyz_m - 1.5 * before.velocity_mps
    change = after.velocity_mps - before.velocity_mps
    weights = motion._p
    moved = np.array(
        [
            np.concatenate(
                [rotation_z(math.tau * k / len(weights)) @ step, rotation_z(math.tau * k / len(weights)) @ change]
            )
            for k in range(len(weights))
        ]
    )
    mean = weights @ moved
    spread = moved.T @ (weights[:, None] * moved) - np.outer(mean, mean)
    level = [0, 1, 3, 4]
    np.testing.assert_allclose(ahead - plain, mean, atol=1e-9)
    np.testing.assert_allclose((covariance - base)[np.ix_(level, level)], spread[np.ix_(level, level)], atol=1e-9)


def test_the_next_prediction_corrects_delayed_odometry():
    motion, (x, P) = trained(), state(4.0)
    # extrapolated: nothing newer was received
    held = OdometrySample(0, 0, sample(4.0).xyz_m + 0.5 * sample(4.0).velocity_mps, sample(4.0).velocity_mps)
    half, half_P = motion.predicted(x, P, 0.5, sample(4.0), held, 1.0, 0.02)
    whole, _ = motion.predicted(half, half_P, 0.5, held, sample(5.0), 1.0, 0.02)
    np.testing.assert_allclose(whole[3:], circle(5.0)[1], atol=0.2)
    lost, _ = motion.predicted(half, half_P, 0.5, sample(4.5), sample(5.0), 1.0, 0.02)  # omits the change meanwhile
    assert np.linalg.norm(lost[3:] - circle(5.0)[1]) > 1.0


def test_a_track_that_does_not_follow_the_odometry_is_not_moved_by_it():
    def bird(t_s):
        return np.array([7.0 * t_s, 9.0, 10.0]), np.array([7.0, 0.0, 0.0])

    motion = trained(4.0, seen=bird)
    assert motion.confidence < 0.05
    x, P = np.concatenate(bird(4.0)), np.diag([0.01] * 3 + [0.04] * 3)
    ahead, covariance = motion.predicted(x, P, 1.0, sample(4.0), sample(5.0), 1.0, 0.02)
    np.testing.assert_allclose(ahead[:3], bird(5.0)[0], atol=0.2)
    assert covariance[3, 3] > 0.9


@pytest.mark.parametrize(
    "after",
    [None, sample(5.0, source=1), sample(5.0, resets=1)],
    ids=["no odometry", "another source", "after a reset"],
)
def test_without_two_samples_of_one_segment_the_velocity_is_constant(after):
    motion, (x, P) = trained(), state(4.0)
    ahead, covariance = motion.predicted(x, P, 1.0, sample(4.0), after, 1.0, 0.02)
    plain, expected = predicted(x, P, 1.0, 1.0)
    np.testing.assert_array_equal(ahead, plain)
    np.testing.assert_array_equal(covariance, expected)


@pytest.mark.parametrize("counts", [False, True], ids=["by its velocity", "by the autopilot's counter"])
def test_a_rotation_of_frame_odom_resets_the_yaw(counts):
    motion, (x, P) = trained(), state(4.02)
    before = motion.sample(at_ns(4.0))
    for k in range(1, 6):
        t_s, yaw_rad = 4.0 + 0.02 * k, YAW_RAD + math.pi / 2
        position = odometry(4.0)[0]  # no step of the position
        velocity = odometry(4.0)[1] if counts else odometry(t_s, yaw_rad=yaw_rad)[1]
        motion.telemetry.add(at_ns(t_s), position, velocity, 1 if counts else None)
    after = motion.sample(at_ns(4.06))
    assert before is not None
    assert after is not None
    assert before[:2] != after[:2]
    plain, expected = predicted(x, P, 0.06, 1.0)
    ahead, covariance = motion.predicted(x, P, 0.06, before, after, 1.0, 0.02)
    np.testing.assert_array_equal(ahead, plain)
    np.testing.assert_array_equal(covariance, expected)
    motion.predicted(x, P, 0.04, after, motion.sample(at_ns(4.1)), 1.0, 0.02)
    assert abs(motion._moments[0]) == 0.0


def test_the_next_track_starts_with_the_yaw_of_the_last():
    motion = trained()
    first = motion._moments[0]
    motion.learn(2, at_ns(4.0), circle(4.0)[0], 0.1)  # a single position has no information on yaw
    motion.telemetry.add(at_ns(4.02), *odometry(4.02))
    motion.learn(2, at_ns(4.15), circle(4.15)[0], 0.1)
    assert abs(motion._moments[0]) > 0.7
    assert abs(np.angle(motion._moments[0]) - np.angle(first)) < 0.1


# the stage

HIDDEN_S = 4.0, 7.0


def swinging(t_s):
    """Forth and back next to the vehicle, always within the fan."""
    w = 1.5
    return (
        np.array([0.0, 9.0 + 3.0 * math.sin(w * t_s), 10.0]),
        np.array([0.0, 3.0 * w * math.cos(w * t_s), 0.0]),
    )


def tracked(with_telemetry):
    """Messages of the tracker for a drone that is hidden for 3 s."""
    stage, out, next_s = LikelihoodTrack(), [], 0.0

    def trajectory(t_s):
        return np.array([swinging(t)[0] for t in np.atleast_1d(t_s)])

    wall = Box((-2.0, 2.0, 4.8), (2.0, 7.0, 5.2))
    seen = [Drone(trajectory), During(wall, *HIDDEN_S)]
    position, velocity = swinging(0.0)
    out += stage.on_detections(
        Detections(
            stamp_ns=at_ns(0.0),
            xyz_vehicle_m=position[None],
            accepted=np.array([True]),
            reasons=("made",),
            summary="made",
            evidence=CandidateEvidence(
                start_ns=at_ns(0.0) - 1,
                candidate_id=np.array([-1]),
                seen_ns=np.array([at_ns(0.0)]),
                velocity_vehicle_mps=velocity[None],
                log_odds=np.array([5.0]),
                probability=np.array([0.993]),
            ),
        )
    )
    for pulses in pulses_seen(seen, dithering(half_rad=math.radians(1.0)), 8.0):
        while with_telemetry and at_ns(next_s) <= pulses.point_stamp_ns[-1]:
            position, velocity = odometry(next_s, swinging)
            out += (
                stage.on_drone_position(
                    DroneLocalPosition(stamp_ns=at_ns(next_s), xyz_odom_m=position, velocity_odom_mps=velocity)
                )
                or ()
            )
            next_s += 0.03
        out += stage.on_pulses(pulses)
    return out


def worst_m(states):
    return max(float(np.linalg.norm(m.xyz_vehicle_m - swinging((m.stamp_ns - START_NS) * 1e-9)[0])) for m in states)


def test_a_hidden_drone_with_telemetry_is_predicted_and_reacquired_at_once():
    out = tracked(with_telemetry=True)
    hidden = [m for m in out if isinstance(m, TrackState) and m.state is TrackingState.COASTING]
    assert hidden
    assert worst_m(hidden) < 0.6
    for m in hidden:
        away = m.xyz_vehicle_m - swinging((m.stamp_ns - START_NS) * 1e-9)[0]
        assert float(away @ np.linalg.solve(m.covariance_m2, away)) < 16.0
    again = [m.stamp_ns for m in out if isinstance(m, DroneFix) and m.stamp_ns > at_ns(HIDDEN_S[1])]
    assert again
    assert again[0] < at_ns(HIDDEN_S[1] + 0.5)


def test_without_telemetry_a_hidden_drone_is_predicted_with_constant_velocity():
    hidden = [
        m for m in tracked(with_telemetry=False) if isinstance(m, TrackState) and m.state is TrackingState.COASTING
    ]
    assert worst_m(hidden) > 2.0
