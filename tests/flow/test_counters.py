"""Counters: totals and rejected inputs, as a mapping and as JSON."""

from __future__ import annotations

import json

from flow.counters import Counters


def test_rejected_inputs_are_kept_next_to_totals():
    counters = Counters({"lost": 7}, {"damaged": 2, "duplicate": 0})
    assert counters.totals == {"lost": 7}
    assert counters.rejected == {"damaged": 2, "duplicate": 0}
    assert counters == {"lost": 7, "rejected: damaged": 2, "rejected: duplicate": 0}
    assert not Counters()


def test_counts_of_a_group_are_kept_by_their_names():
    counters = Counters({"lost": 7}, {"damaged": 2}, {"sent": {"ODOMETRY": 5}})
    assert counters.groups == {"sent": {"ODOMETRY": 5}, "rejected": {"damaged": 2}}
    assert counters == {"lost": 7, "sent: ODOMETRY": 5, "rejected: damaged": 2}
    total = counters + Counters(groups={"sent": {"ODOMETRY": 1, "HEARTBEAT": 2}})
    assert total.groups == {"sent": {"ODOMETRY": 6, "HEARTBEAT": 2}, "rejected": {"damaged": 2}}
    assert Counters.of_json(json.loads(json.dumps(counters.to_json()))).groups == counters.groups


def test_a_plain_mapping_has_totals_only():
    counts = Counters({"lost": 7}, {"damaged": 2})
    assert Counters.of(counts) is counts
    assert Counters.of({"rejected": 3}).rejected == {}
    assert Counters.of({"rejected": 3}).totals == {"rejected": 3}


def test_counters_are_copies():
    live = {"lost": 1}
    counters = Counters(live)
    live["lost"] = 2
    assert counters["lost"] == 1


def test_the_sum_adds_equal_names_and_reasons():
    total = Counters({"lost": 1}, {"damaged": 2}) + Counters({"lost": 3, "late": 1}, {"damaged": 1})
    assert (total.totals, total.rejected) == ({"lost": 4, "late": 1}, {"damaged": 3})


def test_counters_cross_to_another_process_as_json():
    counters = Counters({"lost": 7}, {"damaged": 2})
    again = Counters.of_json(json.loads(json.dumps(counters.to_json())))
    assert (again.totals, again.rejected) == (counters.totals, counters.rejected)
