"""What happens in a flight, as the flight's outcome counts it and the recording lists it.

Source: ours.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


class EventKind(enum.Enum):
    """Kind of an event; the value begins its text."""

    PLAN = "plan"  # a step of the plan begins
    SOURCE_SET = "source set"
    ARMED = "armed"
    NOT_ARMED = "not armed"
    LANDED = "landed"
    LANE = "lane"
    EKF_FAILSAFE = "EKF failsafe"
    EKF_RESET = "EKF reset"
    REBOOT = "reboot"


@dataclass(frozen=True, slots=True)
class FlightEvent:
    """An event at a time after the start."""

    time_s: float
    kind: EventKind
    detail: str = ""  # for people
    number: int = 0  # of the source set or lane
    holds: bool = False  # the step of the plan holds the target

    def __str__(self) -> str:
        if self.kind in (EventKind.SOURCE_SET, EventKind.LANE):
            return f"{self.kind.value} {self.number}"
        return f"{self.kind.value}: {self.detail}" if self.detail else self.kind.value
