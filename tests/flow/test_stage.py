"""A node is a plain object with its settings: their class is read from the generic base."""

from __future__ import annotations

import pickle

import pytest
from pydantic import Field, ValidationError

from flow.link import Source, SourceSettings, Tap
from flow.stage import Settings, Stage


class GainSettings(Settings):
    gain: float = Field(2.0, gt=0)


class Gain(Stage[GainSettings]):
    pass


class Inverted(Gain):
    pass


class OffsetGainSettings(GainSettings):
    offset: float = 0.0


class OffsetGain(Gain):
    settings_type = OffsetGainSettings


class Plain(Tap):
    pass


class Counter(Source):
    pass


@pytest.mark.parametrize(
    ("node", "settings"),
    [
        (Gain, GainSettings),
        (Inverted, GainSettings),
        (OffsetGain, OffsetGainSettings),
        (Plain, Settings),
        (Counter, SourceSettings),
    ],
)
def test_the_settings_of_a_node_are_of_the_type_its_generic_base_names(node, settings):
    assert node.settings_type is settings


def test_a_node_takes_checked_settings_or_their_values():
    settings = GainSettings(gain=3.0)
    assert Gain(settings).settings is settings
    assert Gain(gain=3.0).settings == settings
    assert OffsetGain(gain=3.0, offset=1.0).settings == OffsetGainSettings(gain=3.0, offset=1.0)
    assert Counter(topic="/count").topic == "/count"


def test_values_next_to_settings_are_rejected():
    with pytest.raises(TypeError, match="Gain takes settings or their values, not both"):
        Gain(GainSettings(), gain=3.0)


@pytest.mark.parametrize("values", [{"gain": 0.0}, {"gain": float("inf")}, {"gian": 1.0}])
def test_wrong_values_are_errors_of_the_settings(values):
    with pytest.raises(ValidationError):
        Gain(**values)


def test_settings_are_immutable_while_the_state_of_the_node_is_not():
    node = Gain()
    node.seen = 1
    with pytest.raises(ValidationError, match="frozen"):
        node.settings.gain = 3.0


def test_a_node_and_its_settings_can_be_pickled():
    assert pickle.loads(pickle.dumps(Gain(gain=3.0))).settings == GainSettings(gain=3.0)
