"""Single inputs of the fusion, and faults: inputs of a flight removed, delayed or falsified."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import BranchState, DroneFix, RelativePose, RelativeRotation, ServoState, TrackingState, TrackState
from tests.stages.fuse.imu_flights import ns

Event = tuple[int, str, Any]  # arrival [ns], port, message
Fault = Callable[[list[Event]], Iterable[Event]]


def fix(t, xyz, sigma=0.06, track_id=1, velocity=None, bias_covariance_m2=None) -> DroneFix:
    return DroneFix(
        stamp_ns=ns(t),
        xyz_vehicle_m=np.asarray(xyz, dtype=float),
        covariance_m2=sigma**2 * np.eye(3),
        hits=4,
        track_id=track_id,
        velocity_vehicle_mps=velocity,
        bias_covariance_m2=bias_covariance_m2,
    )


def track(t, state: TrackingState, track_id=1, reason="made") -> TrackState:
    return TrackState(stamp_ns=ns(t), state=state, reason=reason, hits=4, frame_s=0.1, track_id=track_id)


def rotation(t, R, sigma_rad=0.005) -> RelativeRotation:
    """One of four branches, not decided: the heading selects it."""
    covariance = sigma_rad**2 * np.eye(3)
    return RelativeRotation.one(ns(t), R, covariance, np.full(4, 0.24), BranchState.OPEN, 0, "made")


def servo(t) -> ServoState:
    return ServoState(stamp_ns=ns(t), position_rad=0.0, velocity_radps=0.0, goal_rad=0.0, error=0)


def poses_of(stage, events: list[Event]) -> list[RelativePose]:
    """Poses that the stage publishes over these events."""
    made = (m for _, port, message in events for m in getattr(stage, f"on_{port}")(message))
    return [m for m in made if isinstance(m, RelativePose)]


def clocked(events: list[Event]) -> list[Event]:
    """These events with the servo's messages, 100 a second."""
    first, last = events[0][0], events[-1][0]
    states = [servo((at_ns - ns(0.0)) * 1e-9) for at_ns in range(first, last, 10_000_000)]
    return sorted([*events, *((m.stamp_ns, "servo", m) for m in states)], key=lambda e: e[0])


# faults


def without(ports: tuple[str, ...], from_s: float = -math.inf, until_s: float = math.inf) -> Fault:
    """Messages of these ports between two times of the flight, by their stamps, are lost."""

    def fault(events: list[Event]) -> list[Event]:
        first = events[0][0]
        return [e for e in events if e[1] not in ports or not from_s <= (e[2].stamp_ns - first) * 1e-9 < until_s]

    return fault


def late(ports: tuple[str, ...], by_s: float) -> Fault:
    """Messages of these ports are delayed, in the same order."""

    def fault(events: list[Event]) -> list[Event]:
        moved = [(at + round(by_s * 1e9) if port in ports else at, port, m) for at, port, m in events]
        return sorted(moved, key=lambda e: e[0])

    return fault


def outliers(ports: tuple[str, ...], share: float, seed: int = 1) -> Fault:
    """This share of the messages of these ports is false: positions by metres, rotations by tens of degrees."""

    def fault(events: list[Event]) -> list[Event]:
        rng = np.random.default_rng(seed)
        return [
            (at, port, falsified(m, rng) if port in ports and rng.random() < share else m) for at, port, m in events
        ]

    return fault


def falsified(message: Any, rng: np.random.Generator) -> Any:
    """The same message with wrong values."""
    changed: dict[str, Any] = {}
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if value is None or "covariance" in name:
            continue
        if name == "autopilot":
            changed[name] = falsified(value, rng)
        elif name.startswith("xyz_"):
            changed[name] = value + rng.normal(0, 3.0, 3)
        elif name.startswith("velocity_"):
            changed[name] = value + rng.normal(0, 2.0, 3)
        elif name.startswith("R_"):
            changed[name] = value @ exp_rotation(rng.normal(0, 0.4, 3))
        elif name.startswith("specific_force_drone"):
            changed[name] = value + rng.normal(0, 5.0, 3)
        elif name.startswith("angular_velocity_drone"):
            changed[name] = value + rng.normal(0, 1.0, 3)
    return replace(message, **changed)
