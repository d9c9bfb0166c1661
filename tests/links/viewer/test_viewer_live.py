"""Edge statistics and events of a live run in the viewer."""

from __future__ import annotations

import pytest
from drawing import drawn, values_of

from flow.events import EventMessage
from flow.live.report import EdgeStatus


@pytest.mark.parametrize(("name", "value"), [("lag_ms", 12.5), ("dropped", 3), ("missed", 1), ("waiting", 7)])
def test_lag_and_drops_of_an_edge_are_curves(name, value):
    status = EdgeStatus(stamp_ns=1, lag_ms=12.5, dropped=3, missed=1, waiting=7)
    entities = drawn(status, "run/track/pulses")
    assert set(entities) == {f"plots/fields/run/track/pulses/{n}" for n in ("lag_ms", "dropped", "missed", "waiting")}
    assert entities[f"plots/fields/run/track/pulses/{name}"].values.tolist() == [value]


@pytest.mark.parametrize(("resolved", "level"), [(False, "WARN"), (True, "INFO")])
def test_an_event_is_logged_under_the_node_it_concerns(resolved, level):
    event = EventMessage(stamp_ns=1, node="servo", text="has sent nothing for 2 s (3 times)", resolved=resolved)
    entities = drawn(event, "run/events")
    assert list(entities) == ["log/run/events/servo"]
    entry = entities["log/run/events/servo"].archetypes[0]
    assert values_of(entry.text) == ["has sent nothing for 2 s (3 times)"]
    assert values_of(entry.level) == [level]
