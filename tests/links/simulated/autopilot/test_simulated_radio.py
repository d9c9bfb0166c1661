"""A radio link: late, in order, lossy as configured."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from links.simulated.autopilot.radio import Radio, RadioSettings

MS, S = 1_000_000, 1_000_000_000


def _send(settings: RadioSettings, count: int, period_ns: int = 10 * MS, size: int = 40) -> list[int | None]:
    radio = Radio(settings, 0, np.random.default_rng(1))
    return [radio.arrival_ns(i * period_ns, size) for i in range(count)]


def test_latency_and_jitter_are_as_configured_and_order_is_kept() -> None:
    arrivals = np.array(_send(RadioSettings(latency_s=0.02, jitter_s=0.001), 5000))
    late_ms = (arrivals - np.arange(5000) * 10 * MS) / MS
    assert late_ms.min() >= 20.0
    assert late_ms.mean() == pytest.approx(21.0, abs=0.1)
    assert (np.diff(arrivals) > 0).all()


def test_a_slow_link_queues_frames() -> None:
    arrivals = _send(RadioSettings(latency_s=0, jitter_s=0, bitrate_bps=9600), 50, period_ns=10 * MS, size=24)
    assert arrivals[-1] == 50 * 25 * MS  # 24 bytes take 25 ms, a frame is sent every 10 ms


def test_losses_have_their_fraction_and_come_in_bursts() -> None:
    lost = np.array([a is None for a in _send(RadioSettings(loss_fraction=0.1, loss_burst_frames=4), 60_000)])
    assert lost.mean() == pytest.approx(0.1, rel=0.1)
    bursts = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    assert lost.sum() / bursts == pytest.approx(4.0, rel=0.1)
    assert not any(a is None for a in _send(RadioSettings(), 1000))


def test_in_an_outage_nothing_arrives() -> None:
    arrivals = _send(RadioSettings(outages_s=((1.0, 2.0),)), 300)
    assert [i for i, a in enumerate(arrivals) if a is None] == list(range(100, 200))


def test_an_outage_that_ends_before_it_begins_is_rejected() -> None:
    with pytest.raises(ValidationError, match="from before to"):
        RadioSettings(outages_s=((2.0, 1.0),))
