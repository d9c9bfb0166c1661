"""Tracks moved by the drone's own word: a yaw that is learnt, what it is worth unlearnt, late words, jumps, silence."""

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

YAW_RAD = 2.0  # of the autopilot's frame: its places are Rz(-yaw) times the local ones
RADIUS_M, RATE_RADPS = 4.0, 1.2


def at_ns(t_s):
    return START_NS + round(t_s * 1e9)


def circle(t_s):
    """Place and velocity (3,) on a level circle, local frame."""
    c, s = math.cos(RATE_RADPS * t_s), math.sin(RATE_RADPS * t_s)
    return (
        np.array([RADIUS_M * c, 9.0 + RADIUS_M * s, 10.0]),
        RADIUS_M * RATE_RADPS * np.array([-s, c, 0.0]),
    )


def told(t_s, flown=circle, yaw_rad=YAW_RAD):
    """The same as the autopilot says it."""
    place, velocity = flown(t_s)
    R_odom_raw = rotation_z(-yaw_rad)
    return R_odom_raw @ (place - flown(0.0)[0]), R_odom_raw @ velocity


def taught(seconds=4.0, seen=circle, flown=circle, yaw_rad=YAW_RAD):
    """A drone that told its flight and was seen for so long."""
    motion = OdometryMotionModel(0)
    for k in range(round(seconds / 0.02) + 1):
        t_s = 0.02 * k
        motion.telemetry.add(at_ns(t_s), *told(t_s, flown, yaw_rad))
        if k % 5 == 0 and k:
            motion.learn(1, at_ns(t_s), seen(t_s)[0], 0.1)
    return motion


def sample(t_s, source=0, resets=0):
    return OdometrySample(source, resets, *told(t_s))


def state(t_s):
    return np.concatenate(circle(t_s)), np.diag([0.01] * 3 + [0.04] * 3)


def test_with_the_yaw_learnt_a_track_goes_where_the_drone_went():
    x, P = state(4.0)
    ahead, covariance = taught().predicted(x, P, 2.0, sample(4.0), sample(6.0), 1.0, 0.02)
    place, velocity = circle(6.0)
    # the yaw is known to a degree or two, and the way there is 9 m off a straight line
    np.testing.assert_allclose(ahead[:3], place, atol=0.3)
    np.testing.assert_allclose(ahead[3:], velocity, atol=0.2)
    assert math.sqrt(covariance[0, 0]) < 0.7
    straight, _ = predicted(x, P, 2.0, 1.0)
    assert np.linalg.norm(straight[:3] - place) > 5.0


def test_the_prediction_does_not_depend_on_the_autopilot_s_north():
    x, P = state(4.0)
    one = taught(yaw_rad=0.5)
    other = taught(yaw_rad=0.5 + math.pi / 2)  # whole steps of the grid: the same to the last digits
    a = one.predicted(
        x,
        P,
        1.0,
        OdometrySample(0, 0, *told(4.0, yaw_rad=0.5)),
        OdometrySample(0, 0, *told(5.0, yaw_rad=0.5)),
        1.0,
        0.02,
    )
    turned = 0.5 + math.pi / 2
    b = other.predicted(
        x,
        P,
        1.0,
        OdometrySample(0, 0, *told(4.0, yaw_rad=turned)),
        OdometrySample(0, 0, *told(5.0, yaw_rad=turned)),
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
    # with psi uniform and probability 1 - NONE that it flies so: mean 0, variance |a|^2 / 2 on each level axis
    np.testing.assert_allclose(ahead, plain, atol=1e-9)
    extra = covariance - before_covariance
    expected = 0.5 * (1.0 - NO_ODOMETRY_PRIOR) * float(step[:2] @ step[:2])
    np.testing.assert_allclose(np.diag(extra)[:2], expected, rtol=1e-9)
    np.testing.assert_allclose(extra[0, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.diag(extra)[2], 0.0, atol=1e-12)


def test_the_covariance_is_that_of_the_yaws_weighed():
    motion = taught(0.8)  # a short way: several yaws fit
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


def test_a_word_that_came_late_is_made_good_by_the_next_one():
    motion, (x, P) = taught(), state(4.0)
    held = OdometrySample(
        0, 0, sample(4.0).xyz_m + 0.5 * sample(4.0).velocity_mps, sample(4.0).velocity_mps
    )  # nothing newer was heard
    half, half_P = motion.predicted(x, P, 0.5, sample(4.0), held, 1.0, 0.02)
    whole, _ = motion.predicted(half, half_P, 0.5, held, sample(5.0), 1.0, 0.02)
    np.testing.assert_allclose(whole[3:], circle(5.0)[1], atol=0.2)
    lost, _ = motion.predicted(
        half, half_P, 0.5, sample(4.5), sample(5.0), 1.0, 0.02
    )  # what changed meanwhile is left out
    assert np.linalg.norm(lost[3:] - circle(5.0)[1]) > 1.0


def test_what_does_not_fly_as_told_is_not_moved_by_it():
    def bird(t_s):
        return np.array([7.0 * t_s, 9.0, 10.0]), np.array([7.0, 0.0, 0.0])

    motion = taught(4.0, seen=bird)
    assert motion.confidence < 0.05
    x, P = np.concatenate(bird(4.0)), np.diag([0.01] * 3 + [0.04] * 3)
    ahead, covariance = motion.predicted(x, P, 1.0, sample(4.0), sample(5.0), 1.0, 0.02)
    np.testing.assert_allclose(ahead[:3], bird(5.0)[0], atol=0.2)
    assert covariance[3, 3] > 0.9


@pytest.mark.parametrize(
    "after",
    [None, sample(5.0, source=1), sample(5.0, resets=1)],
    ids=["silent", "another message", "the estimate jumped"],
)
def test_without_two_words_of_one_frame_the_track_flies_on(after):
    motion, (x, P) = taught(), state(4.0)
    ahead, covariance = motion.predicted(x, P, 1.0, sample(4.0), after, 1.0, 0.02)
    plain, expected = predicted(x, P, 1.0, 1.0)
    np.testing.assert_array_equal(ahead, plain)
    np.testing.assert_array_equal(covariance, expected)


@pytest.mark.parametrize("counts", [False, True], ids=["by its velocity", "by the autopilot's counter"])
def test_a_frame_that_was_turned_is_noticed_and_its_yaw_learnt_anew(counts):
    motion, (x, P) = taught(), state(4.02)
    before = motion.sample(at_ns(4.0))
    for k in range(1, 6):
        t_s, yaw_rad = 4.0 + 0.02 * k, YAW_RAD + math.pi / 2
        place = told(4.0)[0]  # no step that its place would show
        velocity = told(4.0)[1] if counts else told(t_s, yaw_rad=yaw_rad)[1]
        motion.telemetry.add(at_ns(t_s), place, velocity, 1 if counts else None)
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


def test_the_next_track_begins_with_the_yaw_of_the_last():
    motion = taught()
    first = motion._moments[0]
    motion.learn(2, at_ns(4.0), circle(4.0)[0], 0.1)  # one place alone says nothing
    motion.telemetry.add(at_ns(4.02), *told(4.02))
    motion.learn(2, at_ns(4.15), circle(4.15)[0], 0.1)
    assert abs(motion._moments[0]) > 0.7
    assert abs(np.angle(motion._moments[0]) - np.angle(first)) < 0.1


# the stage

HIDDEN_S = 4.0, 7.0


def swinging(t_s):
    """To and fro beside the vehicle, in the fan all along."""
    w = 1.5
    return (
        np.array([0.0, 9.0 + 3.0 * math.sin(w * t_s), 10.0]),
        np.array([0.0, 3.0 * w * math.cos(w * t_s), 0.0]),
    )


def followed(tells):
    """All the tracker says of a drone that something hides for 3 s."""
    stage, out, next_s = LikelihoodTrack(), [], 0.0

    def way(t_s):
        return np.array([swinging(t)[0] for t in np.atleast_1d(t_s)])

    wall = Box((-2.0, 2.0, 4.8), (2.0, 7.0, 5.2))
    seen = [Drone(way), During(wall, *HIDDEN_S)]
    place, velocity = swinging(0.0)
    out += stage.on_detections(
        Detections(
            stamp_ns=at_ns(0.0),
            xyz_vehicle_m=place[None],
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
        while tells and at_ns(next_s) <= pulses.point_stamp_ns[-1]:
            place, velocity = told(next_s, swinging)
            out += (
                stage.on_drone_position(
                    DroneLocalPosition(stamp_ns=at_ns(next_s), xyz_odom_m=place, velocity_odom_mps=velocity)
                )
                or ()
            )
            next_s += 0.03
        out += stage.on_pulses(pulses)
    return out


def worst_m(states):
    return max(float(np.linalg.norm(m.xyz_vehicle_m - swinging((m.stamp_ns - START_NS) * 1e-9)[0])) for m in states)


def test_a_hidden_drone_that_tells_its_flight_is_predicted_and_met_again_at_once():
    out = followed(tells=True)
    hidden = [m for m in out if isinstance(m, TrackState) and m.state is TrackingState.COASTING]
    assert hidden
    assert worst_m(hidden) < 0.6
    for m in hidden:
        away = m.xyz_vehicle_m - swinging((m.stamp_ns - START_NS) * 1e-9)[0]
        assert float(away @ np.linalg.solve(m.covariance_m2, away)) < 16.0
    again = [m.stamp_ns for m in out if isinstance(m, DroneFix) and m.stamp_ns > at_ns(HIDDEN_S[1])]
    assert again
    assert again[0] < at_ns(HIDDEN_S[1] + 0.5)


def test_one_that_tells_nothing_is_predicted_straight_on():
    hidden = [m for m in followed(tells=False) if isinstance(m, TrackState) and m.state is TrackingState.COASTING]
    assert worst_m(hidden) > 2.0
