"""EvidenceDetect on made-up skies: what hangs free is a drone after a second of looks, all else is refused and says why.

The skies are made by tests/stages/caster.py; nothing of them went into choosing the numbers of the evidence.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.detect import EvidenceDetect
from stages.messages import Candidates, Detections, VehicleMotion
from tests.stages.caster import Ball, Box, Drone, During, Wire, dithering, flying, pulses_seen, still, sweeping
from tests.stages.made import ON_ITS_SIDE, START_NS

PLACE_M = (0.0, 8.0, 10.0)  # 12.7 m away, 51 deg up
WATCHING = dithering(half_rad=math.radians(1.0))  # as the aim does: each turn a beam comes near
PASS_DEG = 4.5  # so that each swing of it counts as a pass: a verdict every 0.4 s
HANGING = Drone(still(*PLACE_M))


def motion_at(t_s, velocity_mps=(0.0, 0.0, 0.0)):
    return VehicleMotion(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_start_m=t_s * np.asarray(velocity_mps, dtype=np.float64),
        R_start_vehicle=np.eye(3),
        covariance=None,
    )


def run(things, seconds=3.0, servo_rad=WATCHING, drives_mps=(0.0, 0.0, 0.0), **settings):
    """(Candidates, Detections) that the stage tells; drives_mps None: the vehicle does not say how it moves."""
    stage, told, next_s = EvidenceDetect(**{"sweep_deg": PASS_DEG, **settings}), [], 0.0
    for pulses in pulses_seen(things, servo_rad, seconds):
        while drives_mps is not None and START_NS + next_s * 1e9 <= pulses.point_stamp_ns[-1]:
            stage.on_motion(motion_at(next_s, drives_mps))
            next_s += 0.02
        told += stage.on_pulses(pulses)
    for message in told:
        check_arrays(message)
    return [m for m in told if isinstance(m, Candidates)], [m for m in told if isinstance(m, Detections)]


def accepted_after_s(detections):
    """When the first was accepted, inf: never."""
    return next(((d.stamp_ns - START_NS) * 1e-9 for d in detections if d.accepted.any()), math.inf)


def reasons_of(candidates):
    return " | ".join(reason for told in candidates for reason in told.reasons)


def test_ports_are_what_the_graph_wires():
    assert list(input_ports(EvidenceDetect)) == ["motion", "drone_position", "drone_odometry", "pulses"]
    assert set(output_ports(EvidenceDetect)) == {"candidates", "detections"}
    assert EvidenceDetect.optional_inputs == {"motion"}


@pytest.mark.parametrize("seed", range(2))
def test_a_small_thing_that_moves_in_the_free_sky_is_a_drone_after_a_second_or_two_of_looks(seed):
    way = flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4))
    candidates, detections = run([Drone(way, seed=seed)])
    assert 0.4 < accepted_after_s(detections) < 2.3
    last = detections[-1]
    assert last.accepted.tolist() == [True]
    assert last.probability[0] >= 0.99
    assert last.score[0] == pytest.approx(math.log(last.probability[0] / (1 - last.probability[0])))
    truth = way(np.array([(last.seen_ns[0] - START_NS) * 1e-9]))[0]
    np.testing.assert_allclose(last.xyz_vehicle_m[0], truth, atol=0.3)
    np.testing.assert_allclose(last.velocity_vehicle_mps[0], (0.8, 0.0, 0.4), atol=0.6)
    assert last.verdict.startswith("drone at (")
    assert "sectors around it free" in last.reasons[0]
    assert last.candidate_id[0] == candidates[0].candidate_id[0]  # the same thing keeps its number


def test_its_probability_is_told_from_the_first_looks_on_and_grows():
    candidates, _ = run([Drone(flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4)))])
    assert (candidates[0].stamp_ns - START_NS) * 1e-9 < 0.6
    probability = [float(c.probability[0]) for c in candidates]
    assert probability[0] < 0.5 < 0.99 < probability[-1]
    assert candidates[-1].looks[0] > 15


def test_what_hangs_quite_still_in_the_free_sky_stays_a_candidate_because_lamps_do():
    candidates, detections = run([HANGING], 4.2)
    assert accepted_after_s(detections) == math.inf
    assert 0.9 < candidates[-1].probability.max() < 0.99
    assert "it may stand still" in candidates[-1].reasons[0]


BESIDE = {
    "on a pole": (Wire((0.0, 8.0, 0.0), (0.0, 8.0, 9.9), 0.08), ("beside",)),
    "beside a wall": (Box((0.7, 6.0, 0.0), (1.2, 12.0, 14.0)), ("beside",)),
    "on a wire": (Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.03), ("beside",)),
}


@pytest.mark.parametrize("where", BESIDE)
def test_the_same_thing_is_refused_with_a_reason(where):
    other, words = BESIDE[where]
    candidates, detections = run([HANGING, other], 3.0)
    assert accepted_after_s(detections) == math.inf
    assert len(detections) >= 6
    said = reasons_of(candidates) + " | ".join(d.verdict for d in detections)
    assert all(word in said for word in words), said
    assert all(d.verdict.startswith("no drone: ") for d in detections)
    assert all(c.probability.size == 0 or c.probability.max() < 0.9 for c in candidates)


def test_what_is_half_hidden_by_something_nearer_is_counted_as_such():
    edge = Box((-3.0, 4.0, 0.0), (3.0, 4.1, 5.2))  # a nearer wall that covers its lower half
    _, detections = run([Drone(still(*PLACE_M)), edge], 2.0)
    assert accepted_after_s(detections) == math.inf
    assert any("hidden at an end by something nearer" in d.verdict for d in detections)


def test_what_stands_far_behind_it_does_not_matter():
    wall = Box((-12.0, 16.0, 0.0), (12.0, 17.0, 30.0))
    _, detections = run([Drone(flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4))), wall])
    assert accepted_after_s(detections) < 2.3


def test_a_wire_alone_is_never_a_drone():
    _, detections = run([Wire((-20.0, 8.0, 10.0), (20.0, 8.0, 10.0), 0.02)], 3.0)
    assert accepted_after_s(detections) == math.inf


def test_a_single_stray_return_is_not_even_worth_a_look_for_long():
    stray = During(Ball(still(*PLACE_M), 0.02), 0.4, 0.6)
    candidates, detections = run([stray], 2.0)
    assert accepted_after_s(detections) == math.inf
    assert not candidates or candidates[-1].candidate_id.size == 0 or candidates[-1].probability.max() < 0.1


def test_rain_is_never_a_drone():
    class Rain:
        """Each pulse meets a drop, somewhere, once in 2000."""

        rng = np.random.default_rng(8)

        def range_m(self, origin_m, direction, t_s):
            n = len(t_s)
            return np.where(self.rng.random(n) < 0.0005, self.rng.uniform(2.0, 25.0, n), np.inf)

    _, detections = run([Rain()], 3.0)
    assert accepted_after_s(detections) == math.inf


def test_a_smooth_ball_is_a_balloon_and_a_fast_thing_a_bird():
    balloon, refused = run([Ball(flying((-0.8, 8.0, 10.0), (0.8, 0.0, 0.4)), 0.25)])
    assert accepted_after_s(refused) == math.inf
    assert "balloon" in reasons_of(balloon)
    _, refused = run([Drone(flying((-15.0, 8.0, 10.0), (12.0, 0.0, 0.0)), span_m=0.4)])
    assert accepted_after_s(refused) == math.inf


def test_no_drone_is_a_normal_answer_at_the_end_of_each_pass():
    candidates, detections = run([], 2.0)
    assert candidates == []
    assert len(detections) >= 3
    assert all(d.verdict.startswith("no drone: ") and len(d.score) == 0 for d in detections)


def test_searched_intervals_follow_one_another_without_gap():
    for things in ([], [HANGING]):
        _, detections = run(things, 2.0)
        assert detections[0].start_ns == START_NS
        for before, after in pairwise(detections):
            assert before.start_ns < before.stamp_ns
            assert after.start_ns == before.stamp_ns + 1


def test_a_sweep_over_the_whole_sky_finds_houses_no_drone_and_says_how_many_were_refused():
    street = [Box((-9, -40, 0), (-7, 40, 9)), Box((7, -40, 0), (9, 40, 9)), Wire((7.5, 0, 0), (5.0, 0, 11), 0.1)]
    _, detections = run(street, 3.3, servo_rad=sweeping(), sweep_deg=180.0)
    assert accepted_after_s(detections) == math.inf
    ends_s = [(d.stamp_ns - START_NS) * 1e-9 for d in detections]
    assert ends_s == pytest.approx([1.475, 2.95], abs=0.02)  # 177 deg at 120 deg/s, each
    assert "short returns refused at once" in detections[0].verdict


@pytest.mark.parametrize("told", [True, False])
def test_from_a_driving_vehicle_only_its_odometry_tells_what_stands_still(told):
    drives = (1.5, 0.0, 0.0)
    lamp = Ball(flying((2.0, 8.0, 10.0), (-1.5, 0.0, 0.0)), 0.2)  # in the world it stands
    candidates, detections = run([lamp], 2.0, drives_mps=drives if told else None)
    assert accepted_after_s(detections) == math.inf
    if told:
        assert "it may stand still" in candidates[-1].reasons[0]


def test_what_leaves_is_forgotten():
    gone = During(HANGING, 0.0, 2.0)
    stage = EvidenceDetect(sweep_deg=PASS_DEG, forget_s=0.5)
    for pulses in pulses_seen([gone], WATCHING, 4.0):
        list(stage.on_pulses(pulses))
    assert stage._now.bank == []
    assert stage._now.watches == {}


def test_without_free_space_the_sectors_are_not_even_named():
    candidates, _ = run([HANGING], 2.0, free_space=False)
    assert "sectors" not in reasons_of(candidates)


def test_the_same_pulses_give_the_same_answers():
    once, again = (run([Drone(still(*PLACE_M), seed=1)], 1.5) for _ in range(2))
    for a, b in zip(once[0] + once[1], again[0] + again[1], strict=True):
        assert a.reasons == b.reasons
        np.testing.assert_array_equal(a.probability, b.probability)
        np.testing.assert_array_equal(a.xyz_vehicle_m, b.xyz_vehicle_m)


def test_a_slice_without_pulses_is_nothing():
    (pulses,) = list(pulses_seen([], WATCHING, 0.0014, mount=ON_ITS_SIDE))[:1]
    for name in ("point_stamp_ns", "direction_vehicle", "range_m", "laser", "reflectivity"):
        object.__setattr__(pulses, name, getattr(pulses, name)[:0])
    assert list(EvidenceDetect().on_pulses(pulses)) == []


@pytest.mark.parametrize(
    "settings",
    [
        {"span_m": 0.0},
        {"accept_probability": 1.0},
        {"look_again_probability": 0.6},
        {"report_s": 0.0},
        {"evidence": {"luck": 1}},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ValidationError):
        EvidenceDetect(**settings)
