"""The pinned output hashes: `grd verify` replays all of them in CI, the fast suite those of the short recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

import stages.messages
from flow.link import LinkError
from flow.message import Message
from links.runs.output_hashes import (
    CAMERA_CONFIGS,
    CONFIGS,
    Pin,
    PinResult,
    hash_matches,
    output_hash,
    read_pins,
    write_pins,
)

ROOT = Path(__file__).resolve().parents[3]
SHORT = ("einride_vlp16", "mrpt_vlp16_gps", "street_sweep")
PINS = read_pins(ROOT / "recordings", ROOT / "configs")


def name_of(pin):
    return f"{pin.recording.stem}-{pin.config.stem}"


def test_every_committed_recording_is_pinned_under_every_configuration():
    assert [name_of(pin) for pin in PINS if pin.expected is None] == []
    cells = {(pin.recording.stem, pin.config.stem) for pin in PINS}
    assert {config for recording, config in cells if recording == "street_sweep"} == {*CONFIGS}
    assert {config for recording, config in cells if recording == "experiment_1"} == {*CONFIGS, *CAMERA_CONFIGS}


@pytest.mark.parametrize("pin", [pin for pin in PINS if pin.recording.stem in SHORT], ids=name_of)
def test_a_replay_gives_the_pinned_hash(pin):
    assert output_hash(pin.recording, pin.config) == pin.expected


@pytest.mark.slow
@pytest.mark.parametrize("pin", [pin for pin in PINS if pin.recording.stem not in SHORT], ids=name_of)
def test_a_replay_of_an_experiment_gives_the_pinned_hash(pin):
    assert output_hash(pin.recording, pin.config) == pin.expected


def test_no_two_message_types_share_a_schema_number():
    types = [cls for cls in vars(stages.messages).values() if isinstance(cls, type) and issubclass(cls, Message)]
    numbers = [cls.schema for cls in types]
    assert len(types) > 20
    assert all(number.isdigit() for number in numbers)
    assert len(set(numbers)) == len(numbers)


@pytest.mark.parametrize(
    ("expected", "same"),
    [
        ("0123456789abcdef-fedcba9876543210", True),
        ("0123456789abcdef", True),
        ("0123456789abcdef-0000000000000000", False),
        ("0000000000000000", False),
    ],
)
def test_a_hash_is_compared_whole_or_by_its_values_alone(expected, same):
    assert hash_matches(expected, "0123456789abcdef-fedcba9876543210") is same


@pytest.mark.parametrize("expected", ["", "0123", "0123456789ABCDEF", "x" * 33])
def test_an_invalid_output_hash_is_rejected(expected):
    with pytest.raises(LinkError, match="is not an output hash: give 16 hex digits"):
        hash_matches(expected, "0123456789abcdef-fedcba9876543210")


def test_pinning_one_recording_keeps_the_pins_of_others(tmp_path):
    (tmp_path / "hashes.json").write_text('{"a.mcap": {"replay": "old"}, "b.mcap": {"replay": "kept"}}')
    write_pins(tmp_path, [PinResult(Pin(tmp_path / "a.mcap", Path("replay.yaml"), "old"), "new")])
    text = (tmp_path / "hashes.json").read_text()
    assert '"new"' in text
    assert '"kept"' in text
    assert "old" not in text


def test_an_unknown_recording_is_named_with_those_there_are(tmp_path):
    with pytest.raises(LinkError, match=r"no recording 'unknown' in .*; there is none"):
        read_pins(tmp_path, tmp_path, ("unknown",))
