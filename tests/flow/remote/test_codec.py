"""Messages as bytes and back: every class to the last bit; hostile bytes raise CodecError and allocate little."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages_made import messages

import stages.messages
from flow.message import Message, PerPointF64, PerPointI64, Points64, Shape, Vec3, hash_into, message
from flow.remote.codec import decode, encode, encoding_of
from flow.remote.codec_fields import CodecError
from flow.remote.timeline import in_local_time, time_fields
from stages.messages import (
    AutopilotStatus,
    CameraMount,
    CandidateEvidence,
    Detections,
    DroneFix,
    Image,
    LidarFirings,
    MeanShiftResult,
    RelativePose,
    TrackState,
)

CLASSES = sorted(
    (c for c in vars(stages.messages).values() if isinstance(c, type) and issubclass(c, Message) and c is not Message),
    key=lambda c: c.__name__,
)
EXPECTED = {cls.__name__: cls for cls in CLASSES}
A_FIX = DroneFix(
    stamp_ns=7,
    xyz_vehicle_m=np.array([1.0, 2.0, 3.0]),
    covariance_m2=np.eye(3),
    hits=3,
    mean_shift=MeanShiftResult(iterations=2, shift_m=0.5),
)


def hash_of(value: Message) -> bytes:
    hasher = hashlib.sha256()
    hash_into(hasher, hasher, value)
    return hasher.digest()


def sealed(cls: type[Message], body: bytes) -> bytes:
    """A body with a valid head: hostile, but not damaged."""
    name = cls.__name__.encode()
    head = struct.pack(
        "<4sB8sIIB", b"GRDm", 1, encoding_of(cls).fingerprint, zlib.crc32(name + body), len(body), len(name)
    )
    return head + name + body


@message
class Toy(Message):
    flag: bool
    name: str
    xyz_m: Vec3
    end_ns: int | None


def test_the_bytes_follow_the_format():
    toy = Toy(stamp_ns=-2, flag=True, name="äb", xyz_m=np.array([1.0, -2.0, 0.5]), end_ns=None)
    body = struct.pack("<q?I3sI3d?", -2, True, 3, "äb".encode(), 3, 1.0, -2.0, 0.5, False)
    assert encode(toy) == sealed(Toy, body)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.__name__)
def test_every_message_is_decoded_to_the_last_bit(cls):
    @settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(messages(cls))
    def both_ways(sent):
        got = decode(encode(sent), EXPECTED)
        assert type(got) is cls
        assert hash_of(got) == hash_of(sent)

    both_ways()


def test_decoded_arrays_are_writable_aligned_and_contiguous():
    """A kernel would be compiled again for an array that is read-only or not aligned."""
    sent = Image(stamp_ns=1, frame_id="x", grey=np.arange(12, dtype=np.uint8).reshape(4, 3)[::2])
    got = decode(encode(sent), EXPECTED)
    assert isinstance(got, Image)
    assert got.grey.flags.writeable
    assert got.grey.flags.aligned
    assert got.grey.flags.c_contiguous
    np.testing.assert_array_equal(got.grey, [[0, 1, 2], [6, 7, 8]])


def test_a_message_that_is_not_what_its_class_declares_is_not_encoded():
    for wrong, text in [
        ({"xyz_vehicle_m": np.zeros(4)}, r"DroneFix\.xyz_vehicle_m: declared \(3,\), got \(4,\)"),
        ({"xyz_vehicle_m": np.zeros(3, np.float32)}, "declared float64"),
        ({"xyz_vehicle_m": None}, "declared float64"),
        ({"hits": 2**63}, "DroneFix.hits"),
        ({"hits": 1.5}, "DroneFix.hits"),
        ({"mean_shift": MeanShiftResult(iterations=2, shift_m="far")}, "DroneFix.mean_shift"),
        ({"mean_shift": 0.5}, "DroneFix.mean_shift: declared MeanShiftResult, got float"),
        ({"velocity_vehicle_mps": np.zeros((3, 1))}, "DroneFix.velocity_vehicle_mps"),
    ]:
        values = {name: getattr(A_FIX, name) for name in DroneFix.__slots__} | {"stamp_ns": 7} | wrong
        with pytest.raises(CodecError, match=text):
            encode(DroneFix(**values))
    with pytest.raises(CodecError, match=r"TrackState\.state"):
        encode(TrackState(stamp_ns=1, state=CameraMount.DRONE, reason="", hits=0, frame_s=0.1))


def test_a_class_whose_fields_cannot_be_encoded_raises_with_the_field():
    @message
    class Odd(Message):
        things: dict[str, int]

    with pytest.raises(TypeError, match=r"Odd\.things cannot cross to another process or host"):
        encoding_of(Odd)


def test_other_fields_and_damage_are_different_errors():
    old = message(type("DroneFix", (Message,), {"__annotations__": {"hits": "int"}, "__module__": __name__}))
    with pytest.raises(CodecError, match="both hosts must run the same version of grd"):
        decode(encode(old(stamp_ns=1, hits=2)), EXPECTED)
    with pytest.raises(CodecError, match="another class"):
        decode(encode(A_FIX), {"Image": Image})
    damaged = bytearray(encode(A_FIX))
    damaged[-1] ^= 1
    with pytest.raises(CodecError, match="damaged"):
        decode(bytes(damaged), EXPECTED)
    with pytest.raises(CodecError, match="version"):
        decode(encode(A_FIX).replace(b"GRDm\x01", b"GRDm\x02"), EXPECTED)


@message
class Pair(Message):
    at: PerPointI64
    xyz_m: Points64 | None
    names: tuple[str, ...]


def body_of(*parts: bytes) -> bytes:
    return sealed(Pair, struct.pack("<q", 0) + b"".join(parts))


def test_sizes_are_checked_against_the_bytes_that_are_left():
    none, no_names = b"\0", struct.pack("<I", 0)
    two = struct.pack("<I2q", 2, 5, 6)
    assert decode(body_of(two, none, no_names), {"Pair": Pair}).at.tolist() == [5, 6]
    for body, text in [
        (body_of(struct.pack("<I", 2**32 - 1), none, no_names), "cannot be in"),
        (body_of(struct.pack("<I", 1000), none, no_names), "ends too early"),
        (body_of(two, b"\x01" + struct.pack("<II", 3, 3) + bytes(72), no_names), "with n = 2, got"),
        (body_of(two, b"\x01" + struct.pack("<II", 2, 4) + bytes(64), no_names), r"declared \(n, 3\)"),
        (body_of(two, none, struct.pack("<I", 2**31)), "items cannot be in"),
        (body_of(two, none, struct.pack("<II", 1, 2**31)), "ends too early"),
        (body_of(two, b"\x02", no_names), "neither true nor false"),
        (body_of(two, none, struct.pack("<II1s", 1, 1, b"\xff")), "UTF-8"),
        (body_of(two, none, no_names, b"x"), "too many"),
    ]:
        with pytest.raises(CodecError, match=text):
            decode(body, {"Pair": Pair})


def test_an_empty_image_may_not_claim_an_unbounded_side():
    head = struct.pack("<qI", 0, 0)
    assert decode(sealed(Image, head + struct.pack("<IId", 0, 640, 0.0)), EXPECTED).grey.shape == (0, 640)
    with pytest.raises(CodecError, match="cannot be in"):
        decode(sealed(Image, head + struct.pack("<IId", 0, 2**32 - 1, 0.0)), EXPECTED)


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck), database=None)
@given(st.data(), st.sampled_from([Detections, LidarFirings, RelativePose, Image, TrackState, AutopilotStatus]))
def test_hostile_bytes_raise_nothing_but_codec_errors(data, cls):
    """Changed or cut anywhere, or random; with a valid head, so that the body is read."""
    name = cls.__name__.encode()
    whole = encode(data.draw(messages(cls)))
    body = bytearray(whole[22 + len(name) :])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(len(body) - 1, 0)))
        body[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=6))
    for hostile in (sealed(cls, bytes(body)), bytes(body), whole[: len(body)], data.draw(st.binary(max_size=64))):
        with contextlib.suppress(CodecError):
            decode(hostile, EXPECTED)


def test_hostile_bytes_allocate_no_more_memory_than_they_have():
    """Sizes of gigabytes at every position that may hold a size."""
    sent = encode(
        Detections(
            stamp_ns=1, xyz_vehicle_m=np.zeros((2, 3)), accepted=np.zeros(2, bool), reasons=("a", "b"), summary="v",
            evidence=CandidateEvidence(
                start_ns=0, candidate_id=np.zeros(2, np.int64), seen_ns=np.zeros(2, np.int64),
                velocity_vehicle_mps=np.zeros((2, 3)), log_odds=np.zeros(2), probability=np.zeros(2),
            ),
        )
    )  # fmt: skip
    body = sent[22 + len("Detections") :]
    for count in (2**16, 2**24, 2**32 - 1):
        for at in range(len(body) - 4):
            hostile = sealed(Detections, body[:at] + struct.pack("<I", count) + body[at + 4 :])
            tracemalloc.start()
            try:
                decode(hostile, EXPECTED)
            except CodecError:
                pass
            finally:
                _, peak = tracemalloc.get_traced_memory()
                tracemalloc.stop()
            assert peak < 20 * len(hostile) + 20_000


def test_only_times_are_shifted_to_the_local_clock():
    status = AutopilotStatus(
        stamp_ns=100,
        armed=True,
        custom_mode=4,
        failsafe=False,
        lost_frames=2,
        clock_offset_ns=50,
        clock_uncertainty_ns=3,
    )
    moved = in_local_time(status, -30, 5)
    assert (moved.stamp_ns, moved.clock_offset_ns, moved.clock_uncertainty_ns) == (70, 20, 8)
    assert (moved.armed, moved.custom_mode, moved.lost_frames) == (True, 4, 2)
    assert status.stamp_ns == 100

    @message
    class Observed(Message):
        seen_ns: PerPointI64
        rest_ns: PerPointI64 | None
        score: PerPointF64

    observed = Observed(stamp_ns=1, seen_ns=np.array([1, 2]), rest_ns=None, score=np.array([3.0, 4.0]))
    moved = in_local_time(observed, 10, 0)
    assert moved.seen_ns.tolist() == [11, 12]
    assert moved.rest_ns is None
    assert moved.score.tolist() == [3.0, 4.0]


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Offset:
    offset_ns: int
    clock_uncertainty_ns: int


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Observation:
    seen_ns: PerPointI64
    offset: Offset | None
    score: PerPointF64


@message
class Nested(Message):
    found: Observation | Offset | None


def test_times_in_nested_dataclasses_are_shifted():
    seen = Observation(
        seen_ns=np.array([1, 2]), offset=Offset(offset_ns=5, clock_uncertainty_ns=1), score=np.array([3.0])
    )
    moved = in_local_time(Nested(stamp_ns=7, found=seen), 10, 4)
    assert moved.stamp_ns == 17
    assert isinstance(moved.found, Observation)
    assert moved.found.seen_ns.tolist() == [11, 12]
    assert moved.found.offset is not None
    assert (moved.found.offset.offset_ns, moved.found.offset.clock_uncertainty_ns) == (15, 5)
    assert moved.found.score.tolist() == [3.0]
    assert seen.seen_ns.tolist() == [1, 2]
    assert in_local_time(Nested(stamp_ns=7, found=None), 10, 4).found is None
    moved = in_local_time(Nested(stamp_ns=7, found=Offset(offset_ns=5, clock_uncertainty_ns=1)), 10, 4)
    assert isinstance(moved.found, Offset)
    assert moved.found.offset_ns == 15
    assert dict(time_fields(Nested)) == {
        "stamp_ns": False,
        "found.seen_ns": False,
        "found.offset.offset_ns": False,
        "found.offset.clock_uncertainty_ns": True,
        "found.offset_ns": False,
        "found.clock_uncertainty_ns": True,
    }


def test_a_nested_time_beyond_64_bits_raises():
    late = Offset(offset_ns=2**63 - 1, clock_uncertainty_ns=0)
    with pytest.raises(OverflowError, match="no time"):
        in_local_time(Nested(stamp_ns=0, found=late), 1, 0)


@message
class Seen(Message):
    seen_ns: PerPointI64


def test_a_time_beyond_64_bits_raises():
    last_ns = 2**63 - 1
    for stamp_ns, seen_ns in [(last_ns, 0), (0, last_ns)]:
        seen = Seen(stamp_ns=stamp_ns, seen_ns=np.array([seen_ns]))
        with pytest.raises(OverflowError, match="no time"):
            in_local_time(seen, 1, 0)
        assert in_local_time(seen, -1, 0).stamp_ns == stamp_ns - 1


def test_every_time_field_of_the_messages_is_known():
    """A new `_ns` field must be added here: is it a time of the host's clock, or a duration?"""
    found = {f"{c.__name__}.{name}": grows for c in CLASSES for name, grows in time_fields(c) if name != "stamp_ns"}
    assert found == {
        "AutopilotStatus.clock_offset_ns": False,
        "AutopilotStatus.clock_uncertainty_ns": True,
        "CandidateLog.seen_ns": False,
        "Candidates.seen_ns": False,
        "DepthImage.start_ns": False,
        "Detections.evidence.seen_ns": False,
        "Detections.evidence.start_ns": False,
        "DroneMotion.start_ns": False,
        "VisualMotion.from_ns": False,
        "FollowedFeatures.from_ns": False,
        "LidarFirings.pulse_stamp_ns": False,
        "RelativePose.measured_ns": False,
        "RelativePose.rotation_ns": False,
        "SweptPoints.point_stamp_ns": False,
        "SweptPulses.point_stamp_ns": False,
    }


def test_the_declared_shape_is_part_of_the_fingerprint():
    def with_shape(*dims):
        from typing import Annotated

        from numpy.typing import NDArray

        hint = Annotated[NDArray[np.float64], Shape(*dims)]
        return message(type("X", (Message,), {"__annotations__": {"a": hint}, "__module__": __name__}))

    assert encoding_of(with_shape("n", 3)).fingerprint != encoding_of(with_shape("n", 4)).fingerprint
