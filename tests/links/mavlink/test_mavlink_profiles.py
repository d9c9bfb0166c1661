"""Required parameters: the tables, the findings, and reading parameters over a socket."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from links.mavlink.parameters import read_parameters
from links.mavlink.profiles import ARDUPILOT, PROFILES, PX4, Profile, RequiredParameter, findings
from links.mavlink.transport.connection import Endpoint, Udp
from links.mavlink.transport.stream_connection import open_connection
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.px4_rules import Px4Rules


def valid(profile: Profile) -> dict[str, float]:
    """Allowed values."""
    return {w.name: w.values[0] if w.values else float(w.bits) if w.bits else w.at_least for w in profile.required}


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_names_fit_the_message_field_and_each_has_a_reason(profile: Profile):
    names = [parameter.name for parameter in profile.required]
    assert len(set(names)) == len(names)
    assert all(0 < len(name) <= 16 for name in names)
    assert all(parameter.why for parameter in profile.required)
    assert findings(profile, valid(profile)) == []


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_each_wrong_or_missing_parameter_is_one_sentence(profile: Profile):
    values = valid(profile)
    first, second = profile.required[0].name, profile.required[1].name
    values[first] = 99.0
    del values[second]
    found = findings(profile, values)
    assert len(found) == 2
    assert found[0].startswith(f"{first} is 99, but must be")
    assert found[1].startswith(f"{second} was not received")


def test_a_compass_heading_is_found_for_both_autopilots():
    ardupilot, px4 = valid(ARDUPILOT) | {"EK3_SRC1_YAW": 1.0}, valid(PX4) | {"EKF2_EV_CTRL": 7.0}
    assert "a compass would rotate it" in findings(ARDUPILOT, ardupilot)[0]
    assert "8: yaw" in findings(PX4, px4)[0]


@pytest.mark.parametrize(
    ("parameter", "allowed", "rejected"),
    [
        (RequiredParameter("A", (6.0, 0.0)), [6.0, 0.0], [1.0, 5.9, 6.01]),
        (RequiredParameter("B", at_least=0.05, at_most=0.3), [0.05, 0.3, 0.30000001192], [0.04, 0.31]),
        (RequiredParameter("C", bits=9), [9.0, 11.0, 15.0], [1.0, 8.0, 6.0]),
    ],
)
def test_values_ranges_and_bits(parameter: RequiredParameter, allowed: list[float], rejected: list[float]):
    assert all(parameter.fits(v) for v in allowed)
    assert not any(parameter.fits(v) for v in [*rejected, float("nan"), float("inf")])


@pytest.mark.parametrize(
    ("rules", "profile"), [(ArduPilotRules(), ARDUPILOT), (Px4Rules(), PX4)], ids=["ardupilot", "px4"]
)
def test_parameters_are_read_over_a_socket_and_missing_ones_are_named(rules: Any, profile: Profile):
    values = valid(profile)
    absent = profile.required[-1].name
    sent = {name: value for name, value in values.items() if name != absent}
    with AutopilotSocket(rules, parameters=sent) as drone:
        connection = open_connection(Endpoint("udpout", "127.0.0.1", drone.port))
        names = [parameter.name for parameter in profile.required]
        received = read_parameters(
            connection, names, (1, 1), (1, 197), integers_bytewise=profile.integers_bytewise, timeout_s=1.0
        )
        connection.close()
    assert received.missing == [absent]
    assert received.values == pytest.approx(sent)
    assert received.frames >= len(sent)
    assert len(findings(profile, received.values)) == 1


def test_integers_of_px4_are_decoded_bytewise_also_negative_ones():
    sent = {"A": -1.0, "B": 15.0, "C": 2_000_000_000.0, "D": 0.25}
    with AutopilotSocket(Px4Rules(), parameters=sent) as drone:
        connection = open_connection(Endpoint("udpout", "127.0.0.1", drone.port))
        received = read_parameters(connection, list(sent), (1, 1), (1, 197), integers_bytewise=True)
        connection.close()
    assert received.values == sent


def test_a_missing_autopilot_gives_no_values():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        connection = open_connection(Endpoint("udpout", "127.0.0.1", silent.getsockname()[1]))
        assert isinstance(connection, Udp)
        received = read_parameters(connection, ["A"], (1, 1), (1, 197), timeout_s=0.2)
        connection.close()
    assert (received.frames, received.values, received.missing) == (0, {}, ["A"])
