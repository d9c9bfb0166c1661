"""What a live run tells of its edges, in the viewer."""

from __future__ import annotations

import pytest
from shown import drawn, words

from flow.incidents import IncidentTold
from flow.live_report import EdgeStatus


@pytest.mark.parametrize(("name", "value"), [("lag_ms", 12.5), ("dropped", 3), ("missed", 1), ("waiting", 7)])
def test_lateness_and_losses_of_an_edge_are_curves(name, value):
    status = EdgeStatus(stamp_ns=1, lag_ms=12.5, dropped=3, missed=1, waiting=7)
    marks = drawn(status, "run/track/pulses")
    assert set(marks) == {f"plots/other/run/track/pulses/{n}" for n in ("lag_ms", "dropped", "missed", "waiting")}
    assert marks[f"plots/other/run/track/pulses/{name}"].values.tolist() == [value]


@pytest.mark.parametrize(("mended", "level"), [(False, "WARN"), (True, "INFO")])
def test_what_went_wrong_stands_in_the_log_under_who_it_happened_to(mended, level):
    told = IncidentTold(stamp_ns=1, node="servo", text="has said nothing for 2 s (3 times)", mended=mended)
    marks = drawn(told, "run/incidents")
    assert list(marks) == ["log/run/incidents/servo"]
    entry = marks["log/run/incidents/servo"].parts[0]
    assert words(entry.text) == ["has said nothing for 2 s (3 times)"]
    assert words(entry.level) == [level]
