"""The origin on earth: asked for, given once, never over another, never to who cannot be asked."""

from __future__ import annotations

from typing import Any

import pytest
from mavlink_poses import HOST0, MS
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.origin import GlobalOrigin, OriginSender

mavlink: Any = ardupilotmega
PLACE = GlobalOrigin(latitude_deg=-33.8568, longitude_deg=151.2153, altitude_m=-4.25)


def ack(result: int, command: int = 512) -> Any:
    return mavlink.MAVLink_command_ack_message(command, result)


def run(giver: OriginSender, seconds: int, *answers: Any) -> list[Any]:
    """What is sent within some seconds, each request answered so."""
    out: list[Any] = []
    for i in range(10 * seconds):
        sent = giver.due(HOST0 + 100 * i * MS)
        out += sent
        for message in sent:
            if message.get_type() == "COMMAND_LONG":
                for answer in answers:
                    giver.hear(answer)
    return out


@pytest.mark.parametrize("result", [0, 2, 4])
def test_it_is_given_once_after_three_answers_without_an_origin(result: int):
    giver = OriginSender(PLACE, (1, 1))
    sent = run(giver, 30, ack(result))
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"] * 3 + ["SET_GPS_GLOBAL_ORIGIN"]
    assert (sent[0].command, sent[0].param1, sent[0].target_system) == (512, 49.0, 1)
    given = sent[-1]
    assert (given.target_system, given.latitude, given.longitude, given.altitude) == (1, -338568000, 1512153000, -4250)
    assert giver.state == "given"


def test_an_autopilot_that_has_one_keeps_it():
    giver = OriginSender(PLACE, (1, 1))
    sent = run(giver, 30, ack(0), mavlink.MAVLink_gps_global_origin_message(1, 2, 3))
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"]
    assert giver.state == "it has one"


@pytest.mark.parametrize("answers", [(), (ack(3),), (ack(1),), (ack(0, command=511),)])
def test_who_does_not_answer_or_cannot_gets_none(answers: Any):
    giver = OriginSender(PLACE, (1, 1))
    assert {m.get_type() for m in run(giver, 30, *answers)} == {"COMMAND_LONG"}


def test_an_answer_before_it_was_asked_is_anothers():
    giver = OriginSender(PLACE, (1, 1))
    for _ in range(5):
        giver.hear(ack(0))
    assert [m.get_type() for m in giver.due(HOST0)] == ["COMMAND_LONG"]


def test_answers_to_somebody_elses_requests_count_for_one_at_most():
    giver = OriginSender(PLACE, (1, 1))
    assert len(giver.due(HOST0)) == 1
    for _ in range(5):
        giver.hear(ack(0))
    assert [m.get_type() for m in giver.due(HOST0 + 1_100 * MS)] == ["COMMAND_LONG"]


def test_an_origin_that_the_line_did_not_take_is_given_later():
    giver = OriginSender(PLACE, (1, 1))
    for i in range(3):
        giver.due(HOST0 + 1_100 * i * MS)
        giver.hear(ack(0))
    (lost,) = giver.due(HOST0 + 4_000 * MS)
    giver.unsent()
    (given,) = giver.due(HOST0 + 4_100 * MS) or giver.due(HOST0 + 6_000 * MS)
    assert given.get_type() == lost.get_type() == "SET_GPS_GLOBAL_ORIGIN"
    assert giver.state == "given"


def test_an_autopilot_that_was_away_is_asked_again():
    giver = OriginSender(PLACE, (1, 1))
    run(giver, 30, ack(0))
    assert giver.state == "given"
    giver.restart()
    sent = run(giver, 30, ack(0), mavlink.MAVLink_gps_global_origin_message(1, 2, 3))
    assert [m.get_type() for m in sent] == ["COMMAND_LONG"]
    assert giver.state == "it has one"
    none = OriginSender(None, (1, 1))
    none.restart()
    assert none.state == "none configured"


def test_without_an_origin_nothing_is_asked():
    assert run(OriginSender(None, (1, 1)), 30, ack(0)) == []


def test_a_place_off_the_earth_is_refused():
    with pytest.raises(ValidationError):
        GlobalOrigin(latitude_deg=91, longitude_deg=0, altitude_m=0)
