"""Of several IMU messages with the same samples one is used."""

from __future__ import annotations

import pytest

from links.mavlink.streams.imu_stamps import PREFERENCE_TIMEOUT_NS, ImuSelection

MS = 1_000_000


@pytest.mark.parametrize(
    ("kinds", "used"),
    [
        (("RAW_IMU", "HIGHRES_IMU", "SCALED_IMU"), "RAW_IMU"),
        (("SCALED_IMU", "HIGHRES_IMU"), "HIGHRES_IMU"),
        (("SCALED_IMU",), "SCALED_IMU"),
    ],
)
def test_the_first_of_the_preference_that_arrives_is_used(kinds: tuple[str, ...], used: str):
    selection = ImuSelection()
    for kind in kinds:
        selection.accepts(kind, 0)
    accepted = {kind for i in range(1, 20) for kind in kinds if selection.accepts(kind, 20 * i * MS)}
    assert accepted == {used}


def test_the_next_one_is_used_when_it_ends():
    selection = ImuSelection()
    assert selection.accepts("RAW_IMU", 0)
    assert not selection.accepts("HIGHRES_IMU", PREFERENCE_TIMEOUT_NS)
    assert selection.accepts("HIGHRES_IMU", PREFERENCE_TIMEOUT_NS + MS)
    assert selection.accepts("ATTITUDE", 0)
