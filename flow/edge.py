"""An edge of the graph, and what happens on it in a live run when its consumer does not keep up.

    inputs:
      points: sweep.swept_points                                                 # as suits the message, see below
      pulses: {from: sweep.swept_pulses, policy: drop_oldest, depth: 64, deadline_ms: 50}

`latest`: only the newest waits. `drop_oldest`: up to `depth` wait, then the oldest is dropped. What is dropped is
counted. A message that was `deadline_ms` old (by the arrival of the record that caused it) when its consumer had done
with it has missed its deadline and is counted, too.
A replay keeps every message: it has the time.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from flow.message import Message, array_fields
from flow.problem import did_you_mean, one_of

Policy = Literal["latest", "drop_oldest"]
POLICIES: tuple[str, ...] = get_args(Policy)
KEYS = ("from", "policy", "depth", "deadline_ms")
DEPTH = 512  # 0.7 s of a VLP-16's packets: a hiccup of the machine loses none, and what waits is not too old
MAX_DEPTH = 100_000
DEADLINE_MS = 100.0  # the autopilot takes its pose source for lost after some such gaps
MAX_DEADLINE_MS = 60_000.0


@dataclass(frozen=True, slots=True)
class Waiting:
    """How messages wait on an edge of a live run."""

    policy: Policy
    depth: int
    deadline_ms: float = DEADLINE_MS

    def __str__(self) -> str:
        return self.policy if self.policy == "latest" else f"{self.policy} {self.depth}"


@dataclass(frozen=True, slots=True)
class Edge:
    """One wire: an output of one node to an input port of another."""

    producer: str
    output: str
    consumer: str
    port: str
    message: type[Message]
    waiting: Waiting

    @property
    def name(self) -> str:
        """`track.pulses`: each port has one edge."""
        return f"{self.consumer}.{self.port}"


def usual_waiting(message: type[Message]) -> Waiting:
    """`latest` for a picture (an array with two free dimensions): big, and an old one is of no use; else a queue."""
    is_picture = any(sum(isinstance(d, str) for d in shape.dims) > 1 for _, _, shape in array_fields(message))
    return Waiting("latest", 1) if is_picture else Waiting("drop_oldest", DEPTH)


def read_waiting(declared: dict[str, Any], usual: Waiting) -> tuple[Waiting, list[tuple[str, str]]]:
    """The waiting that an input's mapping declares over `usual`, and (key, text) of all that is wrong with it."""
    problems = list(_problems(declared))
    if problems:
        return usual, problems
    policy = cast(Policy, declared.get("policy", usual.policy))
    fitting = 1 if policy == "latest" else max(usual.depth, DEPTH)
    return Waiting(policy, declared.get("depth", fitting), float(declared.get("deadline_ms", usual.deadline_ms))), []


def _problems(declared: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for key in declared:
        if key not in KEYS:
            yield key, f"unknown key '{key}'; there is {one_of(KEYS)}.{did_you_mean(key, KEYS)}"
    policy = declared.get("policy")
    if policy is not None and policy not in POLICIES:
        near = did_you_mean(policy, POLICIES) if isinstance(policy, str) else ""
        yield "policy", f"must be {one_of(POLICIES)}, got {policy!r}.{near}"
    depth = declared.get("depth")
    if depth is not None and not (_is_number(depth) and isinstance(depth, int) and 1 <= depth <= MAX_DEPTH):
        yield "depth", f"must be a whole number from 1 to {MAX_DEPTH}, got {depth!r}."
    elif depth is not None and policy == "latest" and depth != 1:
        yield "depth", "'latest' keeps one message: leave depth out, or take 'drop_oldest'."
    deadline_ms = declared.get("deadline_ms")
    if deadline_ms is not None and not (_is_number(deadline_ms) and 0 < deadline_ms <= MAX_DEADLINE_MS):
        yield "deadline_ms", f"must be a number above 0, up to {MAX_DEADLINE_MS:g}, got {deadline_ms!r}."


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
