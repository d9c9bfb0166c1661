"""Required parameters: the tables, the findings, and reading parameters over a socket."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from links.mavlink.parameters import read_parameters
from links.mavlink.profiles import (
    ARDUPILOT,
    PROFILES,
    PX4,
    Profile,
    ProfileName,
    RequiredParameter,
    YawOutput,
    best_values,
    findings,
    required_parameters,
)
from links.mavlink.transport.connection import Endpoint, Udp
from links.mavlink.transport.stream_connection import open_connection
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.px4_rules import Px4Rules

ALL = [(profile, yaw) for profile in PROFILES for yaw in ("none", "measured")]


@pytest.mark.parametrize(("profile", "yaw"), ALL)
@pytest.mark.parametrize("source_set", [1, 2, 3])
def test_names_fit_the_message_field_and_each_has_a_reason(profile: ProfileName, yaw: YawOutput, source_set: int):
    required = required_parameters(profile, yaw, source_set)
    names = [parameter.name for parameter in required]
    always = [parameter.name for parameter in required if not parameter.when]
    assert len(set(always)) == len(always)
    assert {name for parameter in required for name in parameter.when} <= {*always, "EK3_SRC1_POSXY"}
    assert all(0 < len(name) <= 16 for name in names)
    assert all(parameter.why for parameter in required)
    assert findings(required, best_values(required)) == []


@pytest.mark.parametrize(("profile", "yaw"), ALL)
def test_each_wrong_or_missing_parameter_is_one_sentence(profile: ProfileName, yaw: YawOutput):
    required = required_parameters(profile, yaw)
    values = best_values(required)
    first, second = (parameter.name for parameter in required[:2])
    values[first] = 102.0
    del values[second]
    found = findings(required, values)
    assert len(found) == 2
    assert found[0].startswith(f"{first} is 102, but must be")
    assert found[1].startswith(f"{second} was not received")


@pytest.mark.parametrize(
    ("profile", "yaw", "name", "value", "why"),
    [
        ("ardupilot", "measured", "EK3_SRC2_YAW", 1.0, "a compass would rotate it"),
        ("ardupilot", "none", "EK3_SRC2_YAW", 6.0, "grd sends no yaw"),
        ("ardupilot", "none", "EK3_SRC2_VELXY", 6.0, "grd sends no velocity"),
        ("ardupilot", "none", "EK3_SRC2_VELZ", 6.0, "grd sends no velocity"),
        ("ardupilot", "none", "EK3_SRC_OPTIONS", 1.0, "a fly-away"),
        ("ardupilot", "none", "EK3_SRC_OPTIONS", 3.0, "a fly-away"),
        ("ardupilot", "none", "EK3_SRC1_POSXY", 6.0, "set 1 flies without grd"),
        ("ardupilot", "none", "ARMING_CHECK", 1.0, "refuses arming before grd sends"),
        ("px4", "measured", "EKF2_EV_CTRL", 3.0, "8: yaw"),
        ("px4", "none", "EKF2_EV_CTRL", 9.0, "8 (yaw) are not sent"),
        ("px4", "none", "EKF2_EV_CTRL", 5.0, "4 (velocity)"),
        ("px4", "none", "EKF2_MAG_TYPE", 5.0, "yaw from the compass"),
    ],
)
def test_a_source_that_does_not_fit_what_is_sent_is_found(
    profile: ProfileName, yaw: YawOutput, name: str, value: float, why: str
):
    required = required_parameters(profile, yaw)
    (found,) = findings(required, best_values(required) | {name: value})
    assert found.startswith(f"{name} is {value:g}, but must be")
    assert why in found


@pytest.mark.parametrize(
    ("yaw", "changes", "why"),
    [
        ("none", {"EK3_SRC1_YAW": 1.0, "EK3_SRC2_YAW": 3.0}, "as EK3_SRC1_YAW"),
        ("none", {"EK3_SRC1_YAW": 2.0, "EK3_SRC2_YAW": 2.0}, None),
        ("measured", {"EK3_SRC1_YAW": 1.0, "EK3_SRC2_YAW": 6.0}, None),
        ("measured", {"EK3_SRC1_POSXY": 0.0, "EK3_SRC2_POSZ": 1.0}, "without a position in set 1"),
        ("measured", {"EK3_SRC1_POSXY": 3.0, "EK3_SRC2_POSZ": 1.0}, None),
        ("measured", {"EK3_SRC1_POSXY": 0.0, "EK3_SRC2_POSZ": 6.0}, None),
        ("none", {"EK3_SRC3_POSXY": 0.0, "EK3_SRC3_VELXY": 0.0}, "the pilot's switch can select it"),
        ("none", {"EK3_SRC3_POSXY": 0.0, "EK3_SRC3_VELXY": 5.0}, None),  # optical flow
        (
            "measured",
            {"EK3_SRC1_POSXY": 0.0, "EK3_SRC2_POSZ": 6.0, "EK3_SRC3_POSXY": 0.0, "EK3_SRC3_VELXY": 0.0},
            None,  # set 1 has none either
        ),
        ("measured", {"EK3_SRC3_YAW": 0.0}, "the pilot's switch can select it"),
        ("none", {"EK3_SRC3_POSXY": 6.0}, "grd's poses belong in its own set"),
        ("none", {"EK3_SRC3_VELXY": 6.0}, "grd's poses belong in its own set"),
    ],
)
def test_a_parameter_may_depend_on_another(yaw: YawOutput, changes: dict[str, float], why: str | None):
    required = required_parameters("ardupilot", yaw)
    found = findings(required, best_values(required) | changes)
    assert len(found) == (why is not None)
    assert all(str(why) in text for text in found)


def test_a_mask_without_the_check_of_visual_odometry_lets_the_drone_arm():
    required = required_parameters("ardupilot", "none")
    all_but_it = float((1 << 20) - 2 - (1 << 18))
    assert findings(required, best_values(required) | {"ARMING_CHECK": all_but_it}) == []


@pytest.mark.parametrize(
    ("parameter", "allowed", "rejected"),
    [
        (RequiredParameter("A", (6.0, 0.0)), [6.0, 0.0], [1.0, 5.9, 6.01]),
        (RequiredParameter("B", at_least=0.05, at_most=0.3), [0.05, 0.3, 0.30000001192], [0.04, 0.31]),
        (RequiredParameter("C", bits=9), [9.0, 11.0, 15.0], [1.0, 8.0, 6.0]),
        (RequiredParameter("D", bits=1, bits_off=4), [1.0, 3.0, 9.0], [0.0, 5.0, 4.0]),
    ],
)
def test_values_ranges_and_bits(parameter: RequiredParameter, allowed: list[float], rejected: list[float]):
    assert all(parameter.fits(v) for v in allowed)
    assert not any(parameter.fits(v) for v in [*rejected, float("nan"), float("inf")])


@pytest.mark.parametrize(
    ("rules", "profile"), [(ArduPilotRules(), ARDUPILOT), (Px4Rules(), PX4)], ids=["ardupilot", "px4"]
)
def test_parameters_are_read_over_a_socket_and_missing_ones_are_named(rules: Any, profile: Profile):
    required = required_parameters(profile.name, "none")
    values = best_values(required)
    absent = required[-1].name
    sent = {name: value for name, value in values.items() if name != absent}
    with AutopilotSocket(rules, parameters=sent) as drone:
        connection = open_connection(Endpoint("udpout", "127.0.0.1", drone.port))
        names = [parameter.name for parameter in required]
        received = read_parameters(
            connection, names, (1, 1), (1, 197), integers_bytewise=profile.integers_bytewise, timeout_s=1.0
        )
        connection.close()
    assert received.missing == [absent]
    assert received.values == pytest.approx(sent)
    assert received.frames >= len(sent)
    assert received.version is not None
    assert received.version[:2] >= profile.least_version
    assert len(findings(required, received.values)) == 1


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
