"""What an autopilot must have set: the tables, what is wrong in words, and reading it over a socket."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from links.mavlink.connection import Endpoint, Udp
from links.mavlink.lines import open_connection
from links.mavlink.parameters import read_parameters
from links.mavlink.profiles import ARDUPILOT, PROFILES, PX4, Profile, Wanted, findings
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.px4_rules import Px4Rules


def right(profile: Profile) -> dict[str, float]:
    """Values that fit."""
    return {w.name: w.values[0] if w.values else float(w.bits) if w.bits else w.at_least for w in profile.wanted}


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_names_fit_the_wire_and_each_has_a_reason(profile: Profile):
    names = [wanted.name for wanted in profile.wanted]
    assert len(set(names)) == len(names)
    assert all(0 < len(name) <= 16 for name in names)
    assert all(wanted.why for wanted in profile.wanted)
    assert findings(profile, right(profile)) == []


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_what_is_wrong_or_missing_is_one_sentence_each(profile: Profile):
    values = right(profile)
    first, second = profile.wanted[0].name, profile.wanted[1].name
    values[first] = 99.0
    del values[second]
    found = findings(profile, values)
    assert len(found) == 2
    assert found[0].startswith(f"{first} is 99, and must be")
    assert found[1].startswith(f"{second} did not answer")


def test_a_compass_heading_is_found_in_either_kind():
    ardupilot, px4 = right(ARDUPILOT) | {"EK3_SRC1_YAW": 1.0}, right(PX4) | {"EKF2_EV_CTRL": 7.0}
    assert "a compass would turn it" in findings(ARDUPILOT, ardupilot)[0]
    assert "8: yaw" in findings(PX4, px4)[0]


@pytest.mark.parametrize(
    ("wanted", "fits", "fails"),
    [
        (Wanted("A", (6.0, 0.0)), [6.0, 0.0], [1.0, 5.9, 6.01]),
        (Wanted("B", at_least=0.05, at_most=0.3), [0.05, 0.3, 0.30000001192], [0.04, 0.31]),
        (Wanted("C", bits=9), [9.0, 11.0, 15.0], [1.0, 8.0, 6.0]),
    ],
)
def test_values_ranges_and_bits(wanted: Wanted, fits: list[float], fails: list[float]):
    assert all(wanted.fits(v) for v in fits)
    assert not any(wanted.fits(v) for v in [*fails, float("nan"), float("inf")])


@pytest.mark.parametrize(
    ("rules", "profile"), [(ArduPilotRules(), ARDUPILOT), (Px4Rules(), PX4)], ids=["ardupilot", "px4"]
)
def test_parameters_are_read_over_a_socket_and_missing_ones_are_named(rules: Any, profile: Profile):
    values = right(profile)
    absent = profile.wanted[-1].name
    told = {name: value for name, value in values.items() if name != absent}
    with AutopilotSocket(rules, parameters=told) as drone:
        connection = open_connection(Endpoint("udpout", "127.0.0.1", drone.port))
        names = [wanted.name for wanted in profile.wanted]
        answers = read_parameters(
            connection, names, (1, 1), (1, 197), integers_bytewise=profile.integers_bytewise, timeout_s=1.0
        )
        connection.close()
    assert answers.missing == [absent]
    assert answers.values == pytest.approx(told)
    assert answers.heard >= len(told)
    assert len(findings(profile, answers.values)) == 1


def test_whole_numbers_of_px4_come_as_bytes_also_negative_ones():
    told = {"A": -1.0, "B": 15.0, "C": 2_000_000_000.0, "D": 0.25}
    with AutopilotSocket(Px4Rules(), parameters=told) as drone:
        connection = open_connection(Endpoint("udpout", "127.0.0.1", drone.port))
        answers = read_parameters(connection, list(told), (1, 1), (1, 197), integers_bytewise=True)
        connection.close()
    assert answers.values == told


def test_nobody_there_is_heard_as_nobody():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        connection = open_connection(Endpoint("udpout", "127.0.0.1", silent.getsockname()[1]))
        assert isinstance(connection, Udp)
        answers = read_parameters(connection, ["A"], (1, 1), (1, 197), timeout_s=0.2)
        connection.close()
    assert (answers.heard, answers.values, answers.missing) == (0, {}, ["A"])
