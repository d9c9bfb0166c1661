"""BeamAim with a simulated servo and rotor. The distance of each beam from the drone is computed ray by ray."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from pydantic import ValidationError

from flow.stage import input_ports, output_ports
from stages.aim import BeamAim
from stages.aim.beam_aim import INNER_RAD
from stages.aim.targets import Targets
from stages.geometry.frames import Harmonic, LidarMount
from stages.messages import Candidates, ServoGoal, TrackingState, TrackState
from tests.stages.caster import LASER, PULSE_NS, TURN_NS, Trajectory, beams_lidar, beams_vehicle, flying, packet, still
from tests.stages.made import MS, ON_ITS_SIDE, PACKET_NS, START_NS, servo

TICK_NS = 5 * MS  # 200 servo states a second
LATENCY_S = 0.03  # from a goal to the servo's first move
PULSE_ARRAYS = ("pulse_stamp_ns", "laser", "azimuth_rad", "range_m", "reflectivity", "return_kind", "xyz_lidar_m")
LIMIT_RADPS = 55 * math.tau / 60


@dataclass
class Flight:
    """Servo positions and goals of a run."""

    mount: LidarMount
    stamp_ns: list[int] = field(default_factory=list)
    servo_rad: list[float] = field(default_factory=list)
    goals: list[tuple[float, ServoGoal]] = field(default_factory=list)  # with the time [s] of each

    def missed_m(self, trajectory: Trajectory) -> np.ndarray:
        """Distance of the nearest pulse from the drone in each rotor turn, (turns,)."""
        packets = (self.stamp_ns[-1] - START_NS) // PACKET_NS
        nearest = np.full((self.stamp_ns[-1] - START_NS) // TURN_NS + 1, np.inf)
        for first in range(0, packets, 16):  # few at once stay in the processor's cache
            which = np.arange(first, min(first + 16, packets))
            stamps = (START_NS + which[:, np.newaxis] * PACKET_NS + PULSE_NS).ravel()
            table_rad = table_with_backlash(self.servo_rad, math.radians(self.mount.servo_play_deg) / 2)
            servo_rad = np.interp(stamps - START_NS, np.array(self.stamp_ns) - START_NS, table_rad)
            beams = beams_lidar(stamps, np.tile(LASER, len(which)))
            origin_m, direction = beams_vehicle(self.mount, servo_rad, beams)
            line = trajectory((stamps - START_NS) * 1e-9) - origin_m
            along = np.einsum("ij,ij->i", direction, line)
            rho2 = np.where(along > 0, np.einsum("ij,ij->i", line, line) - along**2, np.inf)
            np.minimum.at(nearest, (stamps - START_NS) // TURN_NS, rho2)
        return np.sqrt(np.maximum(nearest[:-1], 0.0))  # the last turn is not whole

    def ends_reached(self):
        """Goals of a sweep, in order, without repetitions."""
        goals = [round(goal.position_rad, 3) for _, goal in self.goals]
        return [goal for i, goal in enumerate(goals) if i == 0 or goal != goals[i - 1]]


def table_with_backlash(servo_rad: list[float], half_play_rad: float) -> list[float]:
    """Table angles (n,) for servo angles (n,): the table follows the servo at either end of the backlash."""
    table = servo_rad[0]
    return [table := min(max(table, servo - half_play_rad), servo + half_play_rad) for servo in servo_rad]


Publisher = Callable[[BeamAim, float], None]


def fly(aim: BeamAim, seconds: float, publish: Publisher, start_rad=0.3, rotor=True, latency_s=LATENCY_S) -> Flight:
    """Run the stage in closed loop with a servo that follows after the latency, at most at 55 rpm."""
    flight, position, pending, packets = Flight(aim.settings.mount), start_rad, [], 0
    low, high = (math.radians(v) for v in aim.settings.travel_deg)
    goal: ServoGoal | None = None
    for stamp_ns in range(START_NS, START_NS + round(seconds * 1e9), TICK_NS):
        t_s = (stamp_ns - START_NS) * 1e-9
        while rotor and START_NS + packets * PACKET_NS + PULSE_NS[-1] < stamp_ns:
            aim.on_firings(packet(START_NS + packets * PACKET_NS + PULSE_NS, np.zeros(384)))
            packets += 1
        publish(aim, t_s)
        new_goal = aim.on_servo(servo(stamp_ns, position))
        if new_goal is not None:
            assert low - 1e-9 <= new_goal.position_rad <= high + 1e-9
            assert 0 < new_goal.speed_radps <= LIMIT_RADPS + 1e-9
            pending.append((stamp_ns + round(latency_s * 1e9), new_goal))
            flight.goals.append((t_s, new_goal))
        while pending and pending[0][0] <= stamp_ns:
            goal = pending.pop(0)[1]
        flight.stamp_ns.append(stamp_ns)
        flight.servo_rad.append(position)
        if goal is not None:
            step = goal.speed_radps * TICK_NS * 1e-9
            position += min(max(goal.position_rad - position, -step), step)
    return flight


def track_state(
    trajectory: Trajectory, t_s: float, state=TrackingState.TRACKING, track_id=1, sigma_m=0.05
) -> TrackState:
    position_m, soon = trajectory(np.array([t_s, t_s + 0.01]))
    return TrackState(
        stamp_ns=START_NS + round(t_s * 1e9),
        state=state,
        reason="made",
        hits=3,
        frame_s=0.1,
        track_id=track_id,
        xyz_vehicle_m=np.array(position_m),
        velocity_vehicle_mps=(soon - position_m) / 0.01,
        covariance_m2=sigma_m**2 * np.eye(3),
    )


def tracking(*trajectories: Trajectory, until_s=math.inf) -> Publisher:
    """Publish each drone's position at 10 Hz."""

    def publish(aim, t_s):
        if round(t_s * 1000) % 100 == 0 and t_s < until_s:
            for i, trajectory in enumerate(trajectories):
                aim.on_state(track_state(trajectory, t_s, track_id=i + 1))

    return publish


def candidates(
    position_m, t_s, probability, scan_passes=3, seen_s=None, undirected_speed_mps=0.0, detector_instance=START_NS
) -> Candidates:
    """One candidate; seen_s: time of its last return, None: t_s."""
    return Candidates(
        detector_instance=detector_instance,
        stamp_ns=START_NS + round(t_s * 1e9),
        candidate_id=np.array([1]),
        xyz_vehicle_m=np.array([position_m], dtype=np.float64),
        velocity_vehicle_mps=np.zeros((1, 3)),
        probability=np.array([probability]),
        seen_ns=np.array([START_NS + round((t_s if seen_s is None else seen_s) * 1e9)]),
        scan_passes=np.array([scan_passes]),
        reasons=("made",),
        accept_probability=0.95,
        undirected_speed_mps=np.array([undirected_speed_mps]),
    )


def nothing(aim, t_s):
    pass


def towards(azimuth_deg, elevation_deg, range_m=20.0) -> Trajectory:
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    x, y, z = (range_m * v for v in (math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)))
    return still(x, y, z + 0.35)


def test_ports_are_what_the_graph_wires():
    assert {"firings", "servo", "state", "candidates"} <= set(input_ports(BeamAim))
    assert set(output_ports(BeamAim)) == {"servo_goal"}
    assert "candidates" in BeamAim.optional_inputs


def test_without_a_target_it_sweeps_the_whole_travel_forth_and_back():
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 5.0, nothing)
    ends = flight.ends_reached()
    assert ends[:3] in ([3.142, 0.0, 3.142], [0.0, 3.142, 0.0])
    assert np.degrees([min(flight.servo_rad), max(flight.servo_rad)]) == pytest.approx([0, 180], abs=1.0)
    assert 3 <= len(flight.goals) <= 6  # a new goal at the ends, not in between


def test_a_search_covers_every_direction_except_the_gaps_between_beams():
    """Each direction is passed within 0.7 beam spacings, also where aliasing of rotor and servo would hide it."""
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
    trajectory = towards(*DIRECTIONS[where])
    missed = fly(BeamAim(mount=ON_ITS_SIDE), 3.0, tracking(trajectory), start_rad=1.0).missed_m(trajectory)[10:]
    assert np.mean(missed < 0.2) > 0.75  # the others have an offset on purpose
    assert missed.max() < 0.35
    on_it = np.nonzero(missed < 0.2)[0]
    assert np.diff([-1, *on_it, len(missed)]).max() <= 4  # at most 0.4 s without
    assert np.std(missed) > 0.005  # the offsets alternate


def test_with_the_middle_of_the_fan_the_drone_lies_between_two_beams():
    trajectory = towards(*DIRECTIONS["to the side"])
    missed = fly(BeamAim(mount=ON_ITS_SIDE, beams=False), 3.0, tracking(trajectory)).missed_m(trajectory)[10:]
    assert np.median(missed) > 0.25  # 1 deg at 20 m is 0.35 m
    assert np.median(missed) > 3 * np.median(
        fly(BeamAim(mount=ON_ITS_SIDE), 3.0, tracking(trajectory)).missed_m(trajectory)[10:]
    )


def test_a_calibrated_mount_with_sign_zero_and_harmonics_is_aimed_as_well():
    mount = ON_ITS_SIDE.model_copy(
        update={
            "servo_sign": -1,
            "servo_zero_deg": 180.0,
            "servo_harmonics": (Harmonic(order=1, amplitude_deg=1.0, phase_deg=30.0),),
        }
    )
    trajectory = towards(70.0, 45.0)
    missed = fly(BeamAim(mount=mount), 3.0, tracking(trajectory)).missed_m(trajectory)[10:]
    assert np.mean(missed < 0.2) > 0.85


def test_the_gears_backlash_is_compensated_in_both_directions():
    mount = ON_ITS_SIDE.model_copy(update={"servo_play_deg": 2.0})
    there_and_back = lambda t: np.stack([14.0 + 0 * t, 3.0 * np.sin(2.0 * t), 14.0 + 0 * t], axis=-1)  # noqa: E731
    missed = fly(BeamAim(mount=mount), 5.0, tracking(there_and_back)).missed_m(there_and_back)[10:]
    assert np.median(missed) < 0.1  # half the backlash is 0.35 m there
    assert np.mean(missed < 0.2) > 0.8


@pytest.mark.parametrize("latency_s", [0.0, LATENCY_S, 0.045])
@pytest.mark.parametrize("velocity", [(8.0, 0.0, 0.0), (0.0, -6.0, 3.0)])
def test_a_fast_drone_is_led_for_any_servo_latency(velocity, latency_s):
    trajectory = flying(np.array([-8.0, 12.0, 12.0]), velocity)
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.5, tracking(trajectory), start_rad=2.0, latency_s=latency_s)
    missed = flight.missed_m(trajectory)[8:]
    assert np.mean(missed < 0.25) > 0.9
    assert np.median(missed) < 0.1


def test_a_drone_on_the_axis_is_passed_at_the_fans_inner_beam():
    trajectory = towards(0.0, 90.0)
    missed = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, tracking(trajectory)).missed_m(trajectory)[10:]
    assert missed.min() < 0.4  # no beam reaches it: 1 deg is the least distance


def test_two_drones_share_the_rotor_turns():
    trajectories = towards(30.0, 45.0), towards(110.0, 50.0)
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 6.0, tracking(*trajectories))
    for trajectory in trajectories:
        met = np.nonzero(flight.missed_m(trajectory)[10:] < 0.25)[0]
        assert len(met) >= 12  # of 50 turns
        assert np.diff(met).max() <= 12  # observed again within 1.2 s


def test_a_likely_candidate_interrupts_the_sweep():
    trajectory = towards(60.0, 45.0)
    position_m = trajectory(np.zeros(1))[0]

    def publish(aim, t_s):
        if t_s >= 0.9 and round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 2.0, publish)
    before = [goal.position_rad for t, goal in flight.goals if t < 0.9]
    assert {round(p, 3) for p in before} <= {0.0, 3.142}
    first = next(goal for t, goal in flight.goals if t >= 0.9)
    assert 0.01 < first.position_rad < 3.13
    assert np.degrees(np.ptp(flight.servo_rad[:180])) > 60.0  # the sweep was running
    assert np.mean(flight.missed_m(trajectory)[12:] < 0.3) > 0.5


def test_an_unlikely_candidate_does_not_interrupt_it():
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.02, scan_passes=1))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.0, publish, start_rad=0.0)
    assert {round(goal.position_rad, 3) for _, goal in flight.goals} == {3.142}


def test_a_candidate_without_returns_is_excluded_and_the_sweep_continues():
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if t_s < 0.6 and round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 6.0, publish)
    late = [goal.position_rad for t, goal in flight.goals if t > 3.0]
    assert late
    assert {round(p, 3) for p in late} <= {0.0, 3.142}
    assert np.ptp(flight.servo_rad[600:]) > 3.0


def test_while_coasting_the_offsets_from_the_prediction_grow_until_the_whole_travel_is_swept():
    trajectory = towards(80.0, 45.0)

    def publish(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            coasting = t_s >= 1.0
            state = TrackingState.COASTING if coasting else TrackingState.TRACKING
            aim.on_state(track_state(trajectory, t_s, state, sigma_m=0.05 + (t_s - 1.0 if coasting else 0.0)))

    flight = fly(BeamAim(mount=ON_ITS_SIDE, coast_sigma_m=2.0), 6.0, publish, start_rad=1.2)
    positions = np.degrees(flight.servo_rad)
    tracked, coasted, searched = positions[60:200], positions[240:560], positions[700:]
    assert np.ptp(tracked) < 2.0
    assert 2.0 < np.ptp(coasted) < 40.0
    assert np.ptp(searched) > 150.0


def test_after_a_loss_it_sweeps_again():
    trajectory = towards(80.0, 45.0)

    def publish(aim, t_s):
        if t_s < 1.0:
            tracking(trajectory)(aim, t_s)
        elif round(t_s * 1000) == 1000:
            aim.on_state(track_state(trajectory, t_s, TrackingState.LOST))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, publish)
    assert {round(goal.position_rad, 3) for t, goal in flight.goals if t > 1.05} <= {0.0, 3.142}
    assert np.degrees(np.ptp(flight.servo_rad[250:])) > 150.0


def test_a_cooldown_does_not_apply_to_the_same_id_of_another_detector_instance():
    targets, position_m = Targets(), (0.0, 8.0, 10.0)
    targets.update_candidates(candidates(position_m, 0.0, 0.5, scan_passes=6), 0.1)
    targets.exclude(targets.by_key["candidate", 1, 1], START_NS, cooldown_s=10.0)
    targets.update_candidates(candidates(position_m, 1.0, 0.5, scan_passes=7), 0.1)
    assert not targets.by_key
    targets.update_candidates(candidates(position_m, 2.0, 0.5, scan_passes=9, detector_instance=START_NS + 1), 0.1)
    assert list(targets.by_key) == [("candidate", 1, 1)]


@pytest.mark.parametrize("reported", [True, False])
def test_a_track_ends_after_a_restart_of_its_tracker(reported):
    """A tracker that was restarted reports no track as LOST: it reports SEARCHING, or nothing."""
    trajectory = towards(80.0, 45.0)

    def publish(aim, t_s):
        if t_s < 1.0:
            tracking(trajectory)(aim, t_s)
        elif reported and round(t_s * 1000) == 1000:
            state = track_state(trajectory, t_s, TrackingState.SEARCHING, track_id=0)
            aim.on_state(replace(state, xyz_vehicle_m=None, velocity_vehicle_mps=None, covariance_m2=None))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 4.0 if reported else 12.5, publish)
    assert np.degrees(np.ptp(flight.servo_rad[250 if reported else -650 :])) > 150.0


# missed observations


def elevation_deg(goal_rad, position_m):
    """Elevation [deg] of a position over the fan's middle, for a servo position."""
    origin_m, middle = beams_vehicle(ON_ITS_SIDE, np.array([goal_rad]), np.array([[0.0, 0.0, 1.0]]))  # the spin axis
    line = position_m - origin_m[0]
    return math.degrees(math.asin(float(line @ middle[0]) / float(np.linalg.norm(line))))


def observations_of(flight):
    """Goals that are no ends of a sweep, with their times [s]."""
    return [(t, goal.position_rad) for t, goal in flight.goals if 0.001 < goal.position_rad < 3.141]


ACROSS_M = np.array([-math.sin(math.radians(60.0)), math.cos(math.radians(60.0)), 0.0])  # the fan, at azimuth 60 deg
SPACING_M = 20.0 * math.radians(2.0)  # between two beams, at 20 m


@pytest.mark.parametrize("spacings", [-0.5, -0.37, -0.25, -0.12, 0.12, 0.25, 0.37, 0.5])
@pytest.mark.parametrize("is_track", [False, True], ids=["candidate", "track"])
def test_the_offsets_after_misses_cover_a_whole_beam_spacing(spacings, is_track):
    """Wherever the drone is between two beams, one of them passes within a quarter of its span."""
    trajectory = towards(60.0, 30.0)
    expected_m = trajectory(np.zeros(1))[0] + spacings * SPACING_M * ACROSS_M  # wrong by this offset

    def publish(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            if is_track:
                coasting = TrackingState.TRACKING if t_s == 0 else TrackingState.COASTING
                state = track_state(still(*expected_m), t_s, coasting, sigma_m=0.05 + 0.3 * t_s)
                aim.on_state(replace(state, hits=0))
            else:
                aim.on_candidates(candidates(expected_m, t_s, 0.95, seen_s=0.0))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 0.9, publish, start_rad=math.radians(60.0))
    missed = flight.missed_m(trajectory)[1:]
    assert missed.min() < 0.25 * 0.5 + 0.02
    goals = np.degrees([goal for _, goal in observations_of(flight)])
    assert len(goals) > 3
    assert len(set(np.round(goals, 2))) >= 3  # the goals differ


def test_a_candidate_with_returns_is_observed_with_small_offsets_to_either_side():
    position_m = towards(60.0, 30.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if round(t_s * 1000) % 20 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.5, publish, start_rad=math.radians(60.0))
    assert len(observations_of(flight)) > 10
    goals_m = 20.0 * np.array([goal for _, goal in observations_of(flight)])
    assert 0.02 < np.ptp(goals_m) < 0.2


@pytest.mark.parametrize(
    ("max_missed", "probability", "observations"), [(5, 0.999, 5), (8, 0.999, 8), (8, 0.6, 5), (8, 0.4, 3)]
)
def test_consecutive_misses_exclude_a_candidate_sooner_if_it_is_less_probable(max_missed, probability, observations):
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if round(t_s * 1000) % 50 == 0:
            aim.on_candidates(candidates(position_m, t_s, probability, seen_s=0.0))

    aim = BeamAim(mount=ON_ITS_SIDE, max_missed=max_missed, cooldown_s=60.0)
    flight = fly(aim, 2.0, publish, start_rad=math.radians(60.0))
    assert len(observations_of(flight)) == observations
    assert [round(goal.position_rad, 3) for _, goal in flight.goals[1 + observations :]] == [3.142, 0.0]


def test_a_candidate_with_occasional_returns_is_not_excluded():
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if round(t_s * 1000) % 50 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.9, seen_s=0.4 * (t_s // 0.4)))  # every fourth observation

    flight = fly(BeamAim(mount=ON_ITS_SIDE, max_missed=6), 2.3, publish, start_rad=math.radians(60.0))
    assert len(observations_of(flight)) > 18


def test_a_candidate_of_unknown_heading_is_searched_at_the_distance_it_may_have_flown():
    trajectory = towards(60.0, 30.0)
    position_m = trajectory(np.zeros(1))[0]

    def missed_m(undirected_speed_mps):
        def publish(aim, t_s):
            if round(t_s * 1000) % 50 == 0:
                aim.on_candidates(
                    candidates(position_m, t_s, 0.9, seen_s=0.0, undirected_speed_mps=undirected_speed_mps)
                )

        return fly(BeamAim(mount=ON_ITS_SIDE), 0.3, publish, start_rad=math.radians(60.0)).missed_m(trajectory)[1]

    assert missed_m(0.0) < 0.06  # it hovers
    assert missed_m(4.0) > 0.12  # at the next rotor turn it is most likely to either side


def test_the_cooldown_of_a_candidate_doubles_with_each_repetition_up_to_sixteen_fold():
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if round(t_s * 1000) % 50 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.7))

    aim = BeamAim(mount=ON_ITS_SIDE, max_observations=2, cooldown_s=0.2)
    flight = fly(aim, 17.0, publish, start_rad=math.radians(60.0))
    observed_s = np.array([t for t, _ in observations_of(flight)])
    cooldowns_s = np.diff(observed_s)[1::2]  # two observations, a cool-down, two observations
    np.testing.assert_allclose(
        cooldowns_s - [0.2, 0.4, 0.8, 1.6, 3.2, 3.2, 3.2], 0.025, atol=0.03
    )  # until the next candidates


# choice of the beam


@pytest.mark.parametrize("start_deg", [30.0, 42.0, 78.0, 90.0])
@pytest.mark.parametrize("is_track", [False, True], ids=["candidate", "track"])
def test_a_beam_near_the_fans_middle_is_used_even_if_an_outer_one_is_nearer(start_deg, is_track):
    trajectory = towards(60.0, 45.0)
    position_m = trajectory(np.zeros(1))[0]

    def publish(aim, t_s):
        tracking(trajectory)(aim, t_s) if is_track else aim.on_candidates(candidates(position_m, t_s, 0.7))

    flight = fly(BeamAim(mount=ON_ITS_SIDE), 0.8, publish, start_rad=math.radians(start_deg))
    observations = observations_of(flight)
    assert len(observations) > 3
    for _, goal in observations:
        assert abs(elevation_deg(goal, position_m)) < math.degrees(INNER_RAD) + 1.5  # and the offset
        assert abs(elevation_deg(goal, position_m)) > 0.3  # no beam lies in the middle


def test_an_observation_during_the_sweep_uses_the_nearest_beam_and_the_sweep_continues():
    position_m = towards(60.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        if 0.3 <= t_s < 0.75 and round(t_s * 1000) % 50 == 0:
            aim.on_candidates(candidates(position_m, t_s, 0.05, scan_passes=1))

    swept = fly(BeamAim(mount=ON_ITS_SIDE), 2.2, nothing)
    observed = fly(BeamAim(mount=ON_ITS_SIDE), 2.2, publish)
    goals = [goal for _, goal in observations_of(observed)]
    assert 1 <= len(goals) <= 3
    assert any(abs(elevation_deg(goal, position_m)) > math.degrees(INNER_RAD) + 1.5 for goal in goals)
    at_s = [np.argmax(np.degrees(flight.servo_rad) > 175.0) * TICK_NS * 1e-9 for flight in (swept, observed)]
    assert at_s[0] > 0.5
    assert at_s[1] < at_s[0] + 0.25


# several drones


def test_while_fewer_drones_than_expected_are_tracked_the_search_continues_between_observations():
    trajectory = towards(60.0, 45.0)
    one = fly(BeamAim(mount=ON_ITS_SIDE), 5.0, tracking(trajectory), start_rad=1.0)
    two = fly(BeamAim(mount=ON_ITS_SIDE, max_drones=2), 5.0, tracking(trajectory), start_rad=1.0)
    ends = [[t for t, goal in flight.goals[1:] if goal.position_rad in (0.0, math.pi)] for flight in (one, two)]
    assert ends[0] == []
    assert len(ends[1]) > 2
    assert np.degrees(np.ptp(one.servo_rad[100:])) < 5.0
    assert np.degrees(np.ptp(two.servo_rad[100:])) > 90.0  # each segment continues where the last one ended
    met = np.nonzero(two.missed_m(trajectory)[10:] < 0.25)[0]
    assert len(met) > 8  # of 40
    assert np.diff(met).max() <= 16  # observed again within 1.6 s: the movement there, `search_s` and the movement back


def in_chains(*trajectories: Trajectory) -> Publisher:
    """Publish each drone's position at 10 Hz as track 1 of a chain of its own."""

    def publish(aim, t_s):
        if round(t_s * 1000) % 100 == 0:
            for chain, trajectory in enumerate(trajectories, 1):
                getattr(aim, "on_state" if chain == 1 else f"on_state_{chain}")(track_state(trajectory, t_s))

    return publish


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow), 8])
def test_the_drone_of_each_chain_is_observed_again_before_its_track_is_lost(count):
    trajectories = [towards(10.0 + 340.0 * k / count, 45.0) for k in range(count)]
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 12.0, in_chains(*trajectories), start_rad=0.5)
    for trajectory in trajectories:
        met = np.nonzero(flight.missed_m(trajectory) < 0.25)[0]
        assert np.diff([0, *met, 120]).max() <= 50  # turns of 0.1 s; a track is lost after 6 s


def test_chains_that_follow_one_object_do_not_end_the_search():
    one, other = towards(60.0, 45.0), towards(160.0, 45.0)
    same = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, in_chains(one, one), start_rad=1.0)
    two = fly(BeamAim(mount=ON_ITS_SIDE), 4.0, in_chains(one, other), start_rad=1.0)
    ends = [[t for t, goal in flight.goals[1:] if goal.position_rad in (0.0, math.pi)] for flight in (same, two)]
    assert len(ends[0]) > 2
    assert ends[1] == []


def test_a_chain_without_a_track_does_not_end_the_track_of_another_and_is_searched_for():
    trajectory, aim = towards(60.0, 45.0), BeamAim(mount=ON_ITS_SIDE)
    idle = track_state(trajectory, 0.0, TrackingState.SEARCHING, track_id=0)

    def publish(aim, t_s):
        tracking(trajectory)(aim, t_s)
        if round(t_s * 1000) % 500 == 0:
            stamp_ns = START_NS + round(t_s * 1e9)
            aim.on_state_2(replace(idle, stamp_ns=stamp_ns, xyz_vehicle_m=None, velocity_vehicle_mps=None))

    flight = fly(aim, 5.0, publish, start_rad=1.0)
    assert np.degrees(np.ptp(flight.servo_rad[100:])) > 90.0
    met = np.nonzero(flight.missed_m(trajectory)[10:] < 0.25)[0]
    assert len(met) > 8  # of 40
    assert np.diff(met).max() <= 16


def test_equal_ids_of_two_chains_are_two_candidates():
    targets = Targets()
    targets.update_candidates(candidates((0.0, 8.0, 10.0), 0.0, 0.5), 0.1)
    targets.update_candidates(candidates((9.0, 1.0, 10.0), 0.0, 0.5, detector_instance=START_NS + 1), 0.1, chain=2)
    assert list(targets.by_key) == [("candidate", 1, 1), ("candidate", 2, 1)]
    targets.exclude(targets.by_key["candidate", 2, 1], START_NS, cooldown_s=10.0)
    targets.update_candidates(candidates((0.0, 8.0, 10.0), 1.0, 0.5), 0.1)
    assert list(targets.by_key) == [("candidate", 1, 1)]


def test_a_longer_search_segment_is_wider():
    trajectory = towards(60.0, 45.0)
    widths = []
    for search_s in (0.2, 0.6):
        aim = BeamAim(mount=ON_ITS_SIDE, max_drones=2, search_s=search_s)
        widths.append(np.ptp(fly(aim, 2.0, tracking(trajectory), start_rad=1.0).servo_rad[100:]))
    assert widths[1] > 1.3 * widths[0]


def test_with_as_many_drones_as_expected_the_search_ends():
    trajectories = towards(30.0, 45.0), towards(110.0, 50.0)
    flight = fly(BeamAim(mount=ON_ITS_SIDE, max_drones=2), 4.0, tracking(*trajectories), start_rad=0.5)
    assert len(observations_of(flight)) == len(flight.goals) - 1  # except the first, before the rotor's rate was known


def test_tracks_have_priority_over_candidates():
    trajectory, other = towards(80.0, 45.0), towards(20.0, 45.0)(np.zeros(1))[0]

    def publish(aim, t_s):
        tracking(trajectory)(aim, t_s)
        if round(t_s * 1000) % 100 == 0:
            aim.on_candidates(candidates(other, t_s, 0.9))

    missed = fly(BeamAim(mount=ON_ITS_SIDE), 3.0, publish).missed_m(trajectory)[10:]
    assert np.mean(missed < 0.2) > 0.85


def test_an_observation_is_held_longer_when_slices_are_longer():
    """Its output comes at the end of the slice."""
    held_ms = {}
    for count in (1, 8, 38):
        aim, trajectory = BeamAim(mount=ON_ITS_SIDE), towards(80.0, 45.0)
        end_ns = START_NS + 38 * PACKET_NS
        packets = [packet(end_ns - k * PACKET_NS + PULSE_NS, np.zeros(384)) for k in range(count, 0, -1)]
        arrays = {name: [getattr(p, name) for p in packets] for name in PULSE_ARRAYS}
        aim.on_firings(replace(packets[0], **{name: np.concatenate(parts) for name, parts in arrays.items()}))
        aim.on_state(track_state(trajectory, 0.05))
        goals_ms = [ms for ms in range(400) if aim.on_servo(servo(end_ns + ms * MS, 0.3)) is not None]
        held_ms[count] = goals_ms[1] - goals_ms[0]
    assert held_ms[1] == held_ms[8]
    assert held_ms[38] - held_ms[8] == pytest.approx(38 * PACKET_NS / MS - 12, abs=1.0)


def test_the_goals_stay_within_a_narrow_travel():
    trajectory = towards(80.0, 45.0)
    aim = BeamAim(mount=ON_ITS_SIDE, travel_deg=(30.0, 60.0))
    flight = fly(aim, 2.0, tracking(trajectory), start_rad=math.radians(45))  # the limits are checked in fly
    assert flight.goals


def test_while_the_rotors_rate_is_unknown_it_sweeps():
    flight = fly(BeamAim(mount=ON_ITS_SIDE), 1.0, tracking(towards(80.0, 45.0)), rotor=False)
    assert {round(goal.position_rad, 3) for _, goal in flight.goals} <= {0.0, 3.142}


def test_a_stalled_servo_is_reversed():
    aim, goals = BeamAim(mount=ON_ITS_SIDE), []
    for k in range(200):
        goal = aim.on_servo(servo(START_NS + k * TICK_NS, 1.0))
        goals += [goal.position_rad] if goal else []
    assert len(goals) >= 2
    assert goals[0] != goals[1]


def test_a_lidar_that_does_not_turn_gets_no_goal():
    assert BeamAim(mount=LidarMount(turns=False)).on_servo(servo(START_NS, 0.0)) is None


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"mount": ON_ITS_SIDE, "travel_deg": (90.0, 90.0)},
        {"mount": ON_ITS_SIDE, "limit_rpm": 0},
        {"mount": ON_ITS_SIDE, "max_drones": 0},
        {"mount": ON_ITS_SIDE, "max_missed": 0},
        {"mount": ON_ITS_SIDE, "mistyped": 1},
    ],
)
def test_impossible_settings_are_rejected(settings):
    with pytest.raises((ValidationError, ValueError)):
        BeamAim(**settings)
