"""Global origin: requested, sent until confirmed, never over an existing one, only to an autopilot that replies."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.origin import GlobalOrigin, OriginSender, OriginState
from tests.links.mavlink.mavlink_poses import HOST0, MS

mavlink: Any = ardupilotmega
ORIGIN = GlobalOrigin(latitude_deg=-33.8568, longitude_deg=151.2153, altitude_m=-4.25)


def ack(result: int, command: int = 512) -> Any:
    return mavlink.MAVLink_command_ack_message(command, result)


def run(sender: OriginSender, seconds: int, *replies: Any) -> list[Any]:
    """Messages sent within some seconds, with these replies to each request."""
    out: list[Any] = []
    for i in range(10 * seconds):
        sent = sender.due(HOST0 + 100 * i * MS)
        out += sent
        for message in sent:
            if message.get_type() == "COMMAND_LONG":
                for reply in replies:
                    sender.on_message(reply)
    return out


@pytest.mark.parametrize("result", [0, 2, 4])
def test_the_origin_is_sent_after_three_replies_without_an_origin_and_again_until_it_is_confirmed(result: int):
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    sent = run(sender, 8, ack(result))
    again = ["COMMAND_LONG", "SET_GPS_GLOBAL_ORIGIN"]
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"] * 3 + ["SET_GPS_GLOBAL_ORIGIN"] + again * 2
    assert (sent[0].command, sent[0].param1, sent[0].target_system) == (512, 49.0, 1)
    origin = sent[-1]
    assert (origin.target_system, origin.latitude, origin.longitude, origin.altitude) == (
        1,
        -338568000,
        1512153000,
        -4250,
    )
    assert sender.state is OriginState.SENT
    assert sender.status is None
    run(sender, 60, ack(result))
    assert "does not confirm the origin" in (sender.status or "")
    sender.on_message(mavlink.MAVLink_gps_global_origin_message(1, 2, 3))
    assert (sender.state, sender.done, sender.status) == (OriginState.CONFIRMED, True, None)
    assert run(sender, 10, ack(result)) == []
    sender.restart()
    assert [m.get_type() for m in run(sender, 1, ack(result))] == ["COMMAND_LONG"]


def test_an_acknowledgement_that_names_another_requester_is_not_ours():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    foreign = mavlink.MAVLink_command_ack_message(512, 3, 0, 0, 255, 190)  # unsupported
    assert {m.get_type() for m in run(sender, 8, foreign)} == {"COMMAND_LONG"}
    assert sender.state is OriginState.REQUESTING


def test_an_autopilot_keeps_its_origin():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    sent = run(sender, 30, ack(0), mavlink.MAVLink_gps_global_origin_message(1, 2, 3))
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"]
    assert sender.state is OriginState.PRESENT


@pytest.mark.parametrize("replies", [(), (ack(3),), (ack(1),), (ack(0, command=511),)])
def test_an_autopilot_that_does_not_reply_gets_no_origin(replies: Any):
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    assert {m.get_type() for m in run(sender, 30, *replies)} == {"COMMAND_LONG"}


def test_a_reply_before_the_request_is_ignored():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    for _ in range(5):
        sender.on_message(ack(0))
    assert [m.get_type() for m in sender.due(HOST0)] == ["COMMAND_LONG"]


def test_replies_to_another_requester_count_once_at_most():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    assert len(sender.due(HOST0)) == 1
    for _ in range(5):
        sender.on_message(ack(0))
    assert [m.get_type() for m in sender.due(HOST0 + 1_100 * MS)] == ["COMMAND_LONG"]


def test_an_origin_that_was_not_sent_is_sent_later():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    for i in range(3):
        sender.due(HOST0 + 1_100 * i * MS)
        sender.on_message(ack(0))
    (lost,) = sender.due(HOST0 + 4_000 * MS)
    sender.on_not_sent()
    (sent,) = sender.due(HOST0 + 4_100 * MS) or sender.due(HOST0 + 6_000 * MS)
    assert sent.get_type() == lost.get_type() == "SET_GPS_GLOBAL_ORIGIN"
    assert sender.state is OriginState.SENT


def test_an_autopilot_that_was_silent_is_asked_again():
    sender = OriginSender(ORIGIN, (1, 1), (1, 197))
    run(sender, 30, ack(0))
    assert sender.state is OriginState.SENT
    sender.restart()
    sent = run(sender, 30, ack(0), mavlink.MAVLink_gps_global_origin_message(1, 2, 3))
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"]
    assert sender.state is OriginState.PRESENT
    none = OriginSender(None, (1, 1), (1, 197))
    none.restart()
    assert none.state is OriginState.NOT_CONFIGURED


def test_without_an_origin_nothing_is_requested():
    assert run(OriginSender(None, (1, 1), (1, 197)), 30, ack(0)) == []


def test_an_invalid_position_is_rejected():
    with pytest.raises(ValidationError):
        GlobalOrigin(latitude_deg=91, longitude_deg=0, altitude_m=0)
