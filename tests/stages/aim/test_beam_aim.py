"""BeamAim with a servo and a rotor that obey physics: what the beams meet, turn by turn, is followed ray by ray."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from pydantic import ValidationError

from flow.stage import input_ports, output_ports
from stages.aim import BeamAim
from stages.geometry import Harmonic, LidarMount
from stages.messages import Candidates, ServoGoal, TrackingState, TrackState
from tests.stages.caster import LASER, PULSE_NS, TURN_NS, Way, beams_lidar, beams_vehicle, flying, packet, still
from tests.stages.made import MS, ON_ITS_SIDE, PACKET_NS, START_NS, servo

TICK_NS = 5 * MS  # 200 servo states a second
LATENCY_S = 0.03  # from a goal to the servo's first move
LIMIT_RADPS = 55 * math.tau / 60


@dataclass
class Flight:
    """What happened."""

    mount: LidarMount
    stamp_ns: list[int] = field(default_factory=list)
    servo_rad: list[float] = field(default_factory=list)
    goals: list[tuple[float, ServoGoal]] = field(default_factory=list)  # with the second each was given

    def missed_m(self, way: Way) -> np.ndarray:
        """How far from the place the nearest pulse of each turn of the rotor passed, (turns,)."""
        packets = (self.stamp_ns[-1] - START_NS) // PACKET_NS
        nearest = np.full((self.stamp_ns[-1] - START_NS) // TURN_NS + 1, np.inf)
        for first in range(0, packets, 16):  # few at once stay in the processor's cache
            which = np.arange(first, min(first + 16, packets))
            stamps = (START_NS + which[:, np.newaxis] * PACKET_NS + PULSE_NS).ravel()
            servo_rad = np.interp(stamps - START_NS, np.array(self.stamp_ns) - START_NS, self.servo_rad)
            beams = beams_lidar(stamps, np.tile(LASER, len(which)))
            origin_m, direction = beams_vehicle(self.mount, servo_rad, beams)
            line = way((stamps - START_NS) * 1e-9) - origin_m
            along = np.einsum("ij,ij->i", direction, line)
            rho2 = np.where(along > 0, np.einsum("ij,ij->i", line, line) - along**2, np.inf)
            np.minimum.at(nearest, (stamps - START_NS) // TURN_NS, rho2)
        return np.sqrt(np.maximum(nearest[:-1], 0.0))  # the last turn is not whole

    def ends_reached(self):
        """Goals of a sweep, in order, without those that repeat."""
        places = [round(goal.position_rad, 3) for _, goal in self.goals]
        return [p for i, p in enumerate(places) if i == 0 or p != places[i - 1]]


Tell = Callable[[BeamAim, float], None]


def fly(aim: BeamAim, seconds: float, tell: Tell, start_rad=0.3, rotor=True, latency_s=LATENCY_S) -> Flight:
    """Let the aim drive a servo that obeys after the latency, at most at 55 rpm."""
    flight, position, orders, packets = Flight(aim.mount), start_rad, [], 0
    low, high = (math.radians(v) for v in aim.travel_deg)
    goal: ServoGoal | None = None
    for stamp_ns in range(START_NS, START_NS + round(seconds * 1e9), TICK_NS):
        t_s = (stamp_ns - START_NS) * 1e-9
        while rotor and START_NS + packets * PACKET_NS + PULSE_NS[-1] < stamp_ns:
            aim.on_firings(packet(START_NS + packets * PACKET_NS + PULSE_NS, np.zeros(384)))
            packets += 1
        tell(aim, t_s)
        decided = aim.on_servo(servo(stamp_ns, position))
        if decided is not None:
            assert low - 1e-9 <= decided.position_rad <= high + 1e-9
            assert 0 < decided.speed_radps <= LIMIT_RADPS + 1e-9
            orders.append((stamp_ns + round(latency_s * 1e9), decided))
            flight.goals.append((t_s, decided))
        while orders and orders[0][0] <= stamp_ns:
            goal = orders.pop(0)[1]
        flight.stamp_ns.append(stamp_ns)
        flight.servo_rad.append(position)
        if goal is not None:
            step = goal.speed_radps * TICK_NS * 1e-9
            position += min(max(goal.position_rad - position, -step), step)
    return flight


def track_state(way: Way, t_s: float, state=TrackingState.TRACKING, track_id=1, sigma_m=0.05) -> TrackState:
    place, soon = way(np.array([t_s, t_s + 0.01]))
    return TrackState(
        stamp_ns=START_NS + round(t_s * 1e9),
        state=state,
        reason="made",
        hits=3,
        frame_s=0.1,
        track_id=track_id,
        xyz_vehicle_m=np.array(place),
        velocity_vehicle_mps=(soon - place) / 0.01,
        covariance_m2=sigma_m**2 * np.eye(3),
    )


def tracking(*ways: Way, until_s=math.inf) -> Tell:
    """Ten times a second, where each drone is."""

    def tell(aim, t_s):
        if round(t_s * 1000) % 100 == 0 and t_s < until_s:
            for i, way in enumerate(ways):
                aim.on_state(track_state(way, t_s, track_id=i + 1))

    return tell


def candidates(place_m, t_s, probability, looks=3) -> Candidates:
    return Candidates(
        stamp_ns=START_NS + round(t_s * 1e9),
        candidate_id=np.array([1]),
        xyz_vehicle_m=np.array([place_m], dtype=np.float64),
        velocity_vehicle_mps=np.zeros((1, 3)),
        probability=np.array([probability]),
        seen_ns=np.array([START_NS + round(t_s * 1e9)]),
        looks=np.array([looks]),
        reasons=("made",),
    )


def nothing(aim, t_s):
    pass


def towards(azimuth_deg, elevation_deg, range_m=20.0) -> Way:
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    x, y, z = (range_m * v for v in (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)))
    return still(x, y, z + 0.35)


def test_ports_are_what_the_graph_wires():
    assert {"firings", "servo", "state", "candidates"} <= set(input_ports(BeamAim))
    assert set(output_ports(BeamAim)) == {"servo_goal"}
    assert "candidates" in BeamAim.optional_inputs


def test_without_a_target_it_sweeps_the_whole_travel_to_and_fro():
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 5.0, nothing)
    ends = flight.ends_reached()
    assert ends[:3] in ([3.142, 0.0, 3.142], [0.0, 3.142, 0.0])
    assert np.degrees([min(flight.servo_rad), max(flight.servo_rad)]) == pytest.approx([0, 180], abs=1.0)
    assert 3 <= len(flight.goals) <= 6  # a new goal at the ends, not in between


def test_a_search_looks_at_every_direction_but_for_the_gaps_between_beams():
    """No place in the sky is passed by farther than 0.7 beam spacings, also none that a beat would hide."""
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.2, nothing, start_rad=0.0)
    rng = np.random.default_rng(0)
    for azimuth, elevation in zip(rng.uniform(0, 360, 8), rng.uniform(15, 75, 8), strict=True):
        # across the fan a direction moves by cos(elevation) of the table's angle
        assert flight.missed_m(towards(azimuth, elevation)).min() < 20.0 * math.radians(0.7 * 2.0 / 2 + 0.15)


DIRECTIONS = {
    "to the side": (90.0, 40.0),
    "ahead, at the end of the travel": (0.0, 30.0),
    "behind": (179.0, 50.0),
    "behind to the right": (230.0, 60.0),
    "nearly overhead": (120.0, 85.0),
    "1.2 deg from the axis": (60.0, 88.8),
}


@pytest.mark.parametrize("where", DIRECTIONS)
def test_a_beam_is_on_the_drone_turn_after_turn(where):
    way = towards(*DIRECTIONS[where])
    missed = fly(BeamAim(mount=ON_ITS_SIDE), 3.0, tracking(way), start_rad=1.0).missed_m(way)[10:]
    assert np.mean(missed < 0.2) > 0.75  # the rest is beside it on purpose
    assert missed.max() < 0.35
    on_it = np.nonzero(missed < 0.2)[0]
    assert np.diff([-1, *on_it, len(missed)]).max() <= 4  # never 0.4 s without
    assert np.std(missed) > 0.005  # not always at the same spot of it: a little beside it in turn


def test_the_middle_of_the_fan_would_leave_it_between_two_beams():
    way = towards(*DIRECTIONS["to the side"])
    missed = fly(BeamAim(mount=ON_ITS_SIDE, beams=False), 3.0, tracking(way)).missed_m(way)[10:]
    assert np.median(missed) > 0.25  # 1 deg at 20 m is 0.35 m
    assert np.median(missed) > 3 * np.median(fly(BeamAim(mount=ON_ITS_SIDE), 3.0, tracking(way)).missed_m(way)[10:])


def test_a_calibrated_mount_with_sign_zero_and_harmonics_is_aimed_as_well():
    mount = ON_ITS_SIDE.model_copy(
        update={
            "servo_sign": -1,
            "servo_zero_deg": 180.0,
            "servo_harmonics": (Harmonic(order=1, amplitude_deg=1.0, phase_deg=30.0),),
        }
    )
    way = towards(70.0, 45.0)
    missed = fly(BeamAim(mount=mount), 3.0, tracking(way)).missed_m(way)[10:]
    assert np.mean(missed < 0.2) > 0.85


@pytest.mark.parametrize("latency_s", [0.0, LATENCY_S, 0.045])
@pytest.mark.parametrize("velocity", [(8.0, 0.0, 0.0), (0.0, -6.0, 3.0)])
def test_a_fast_drone_is_led_however_soon_the_servo_obeys(velocity, latency_s):
    way = flying(np.array([-8.0, 12.0, 12.0]), velocity)
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.5, tracking(way), start_rad=2.0, latency_s=latency_s)
    missed = flight.missed_m(way)[8:]
    assert np.mean(missed < 0.25) > 0.9
    assert np.median(missed) < 0.1


def test_a_drone_straight_over_the_axis_is_still_met_now_and_then():
    way = towards(0.0, 90.0)
    missed = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, tracking(way)).missed_m(way)[10:]
    assert missed.min() < 0.4  # no beam goes there: 1 deg beside is as near as it gets


def test_two_drones_share_the_turns():
    ways = towards(30.0, 45.0), towards(110.0, 50.0)
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 6.0, tracking(*ways))
    for way in ways:
        met = np.nonzero(flight.missed_m(way)[10:] < 0.25)[0]
        assert len(met) >= 12  # of 50 turns
        assert np.diff(met).max() <= 12  # looked at again within 1.2 s


def test_a_likely_candidate_interrupts_the_sweep():
    way = towards(60.0, 45.0)
    place = way(np.zeros(1))[0]

    def tell(aim, t_s):
        if t_s >= 0.9 and round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(place, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.0, tell)
    before = [goal.position_rad for t, goal in flight.goals if t < 0.9]
    assert {round(p, 3) for p in before} <= {0.0, 3.142}
    first = next(goal for t, goal in flight.goals if t >= 0.9)
    assert 0.01 < first.position_rad < 3.13
    assert np.degrees(np.ptp(flight.servo_rad[:180])) > 60.0  # it was on its way
    assert np.mean(flight.missed_m(way)[12:] < 0.3) > 0.5


def test_an_unlikely_candidate_does_not_interrupt_it():
    place = towards(60.0, 45.0)(np.zeros(1))[0]

    def tell(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(place, t_s, 0.02, looks=1))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.0, tell, start_rad=0.0)
    assert {round(goal.position_rad, 3) for _, goal in flight.goals} == {3.142}


def test_a_candidate_that_is_never_there_is_left_alone_and_the_sweep_goes_on():
    place = towards(60.0, 45.0)(np.zeros(1))[0]

    def tell(aim, t_s):
        if t_s < 0.6 and round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(place, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 6.0, tell)
    late = [goal.position_rad for t, goal in flight.goals if t > 3.0]
    assert late
    assert {round(p, 3) for p in late} <= {0.0, 3.142}
    assert np.ptp(flight.servo_rad[600:]) > 3.0


def test_while_coasting_it_looks_farther_and_farther_beside_the_prediction_and_then_everywhere():
    way = towards(80.0, 45.0)

    def tell(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            coasting = t_s >= 1.0
            state = TrackingState.COASTING if coasting else TrackingState.TRACKING
            aim.on_state(track_state(way, t_s, state, sigma_m=0.05 + (t_s - 1.0 if coasting else 0.0)))

    flight = fly(BeamAim(mount=ON_ITS_SIDE, coast_search_s=2.0), 6.0, tell, start_rad=1.2)
    positions = np.degrees(flight.servo_rad)
    tracked, coasted, searched = positions[60:200], positions[240:560], positions[700:]
    assert np.ptp(tracked) < 2.0
    assert 2.0 < np.ptp(coasted) < 40.0
    assert np.ptp(searched) > 150.0


def test_after_a_loss_it_sweeps_again():
    way = towards(80.0, 45.0)

    def tell(aim, t_s):
        if t_s < 1.0:
            tracking(way)(aim, t_s)
        elif round(t_s * 1000) == 1000:
            aim.on_state(track_state(way, t_s, TrackingState.LOST))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, tell)
    assert {round(goal.position_rad, 3) for t, goal in flight.goals if t > 1.05} <= {0.0, 3.142}
    assert np.degrees(np.ptp(flight.servo_rad[250:])) > 150.0


def test_a_track_comes_before_a_candidate():
    way, other = towards(80.0, 45.0), towards(20.0, 45.0)(np.zeros(1))[0]

    def tell(aim, t_s):
        tracking(way)(aim, t_s)
        if round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(other, t_s, 0.9))

    missed = fly(BeamAim(mount=ON_ITS_SIDE), 3.0, tell).missed_m(way)[10:]
    assert np.mean(missed < 0.2) > 0.85


def test_a_narrow_travel_is_kept():
    way = towards(80.0, 45.0)
    aim = BeamAim(mount=ON_ITS_SIDE, travel_deg=(30.0, 60.0))
    flight = fly(aim, 2.0, tracking(way), start_rad=math.radians(45))  # the limits are checked in fly
    assert flight.goals


def test_while_the_rotor_is_not_known_it_sweeps():
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.0, tracking(towards(80.0, 45.0)), rotor=False)
    assert {round(goal.position_rad, 3) for _, goal in flight.goals} <= {0.0, 3.142}


def test_a_servo_that_is_stuck_is_sent_the_other_way():
    aim, goals = BeamAim(mount=ON_ITS_SIDE), []
    for k in range(200):
        goal = aim.on_servo(servo(START_NS + k * TICK_NS, 1.0))
        goals += [goal.position_rad] if goal else []
    assert len(goals) >= 2
    assert goals[0] != goals[1]


def test_a_lidar_that_is_bolted_down_is_not_aimed():
    assert BeamAim(mount=LidarMount(turns=False)).on_servo(servo(START_NS, 0.0)) is None


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"mount": ON_ITS_SIDE, "travel_deg": (90.0, 90.0)},
        {"mount": ON_ITS_SIDE, "limit_rpm": 0},
        {"mount": ON_ITS_SIDE, "mistyped": 1},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises((ValidationError, ValueError)):
        BeamAim(**settings)
