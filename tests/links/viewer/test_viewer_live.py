"""What a live run tells of its edges, in the viewer."""

from __future__ import annotations

import pytest
from shown import drawn

from flow.live_report import EdgeStatus


@pytest.mark.parametrize(("name", "value"), [("lag_ms", 12.5), ("dropped", 3), ("missed", 1), ("waiting", 7)])
def test_lateness_and_losses_of_an_edge_are_curves(name, value):
    status = EdgeStatus(stamp_ns=1, lag_ms=12.5, dropped=3, missed=1, waiting=7)
    marks = drawn(status, "run/track/pulses")
    assert set(marks) == {f"plots/other/run/track/pulses/{n}" for n in ("lag_ms", "dropped", "missed", "waiting")}
    assert marks[f"plots/other/run/track/pulses/{name}"].values.tolist() == [value]
