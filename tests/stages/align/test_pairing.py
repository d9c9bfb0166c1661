"""Images are paired with the nearest, as soon as no nearer one can arrive."""

from __future__ import annotations

from stages.align.pairing import Pairing
from stages.messages import CameraMount
from tests.stages.align.made_lines import MS, nothing


def run(events, furthest_ms=100):
    """Events ("v" or "d", ms) -> pairs (vehicle ms or None, drone ms), each with the number of events before it."""
    pairing, out = Pairing(furthest_ms * MS), []
    for count, (kind, ms) in enumerate(events, 1):
        camera_mount = CameraMount.VEHICLE if kind == "v" else CameraMount.DRONE
        seen = nothing(camera_mount, ms * MS)
        ready = pairing.vehicle(seen) if kind == "v" else pairing.drone(seen)
        out += [(v and v.stamp_ns // MS, d.stamp_ns // MS, count) for v, d in ready]
    out += [(v and v.stamp_ns // MS, d.stamp_ns // MS, None) for v, d in pairing.rest()]
    return out


def test_images_of_the_same_time_are_paired_at_once_in_any_order():
    assert run([("v", 100), ("d", 100)]) == [(100, 100, 2)]
    assert run([("d", 100), ("v", 100)]) == [(100, 100, 2)]


def test_the_next_image_is_awaited_when_it_may_be_nearer():
    assert run([("v", 0), ("v", 100), ("d", 180), ("v", 200)]) == [(200, 180, 4)]


def test_the_next_image_is_not_awaited_when_it_cannot_be_nearer():
    assert run([("v", 0), ("v", 100), ("d", 140), ("v", 200)]) == [(100, 140, 3)]


def test_each_drone_image_is_paired_once_and_in_order():
    events = sorted([("v", 33 + 100 * i) for i in range(8)] + [("d", 70 * i) for i in range(10)], key=lambda e: e[1])
    pairs = run(events)
    assert [d for _, d, _ in pairs] == [70 * i for i in range(10)]
    assert all(abs(v - d) <= 50 for v, d, _ in pairs)


def test_without_a_near_vehicle_image_the_pair_has_none():
    assert run([("v", 0), ("v", 100), ("d", 400), ("v", 700)]) == [(None, 400, 4)]


def test_a_failed_camera_does_not_block_pairs():
    assert run([("d", 100 * i) for i in range(5)])[0] == (None, 0, 4)


def test_waiting_images_are_paired_at_the_end():
    assert run([("v", 0), ("v", 100), ("d", 180)]) == [(100, 180, None)]


def test_a_late_image_of_the_vehicle_is_ignored():
    assert run([("v", 100), ("v", 40), ("d", 50)]) == [(100, 50, 3)]
