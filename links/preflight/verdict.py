"""What a check says: a name, how bad it is, and one sentence with what was found and what to do.

Source: ours; issue 6, "go / no-go in words".
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass


class Level(enum.Enum):
    """How bad it is. A warning is for a person to judge, and does not forbid the flight."""

    OK = "ok"
    WARNING = "warning"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer of one check."""

    name: str
    level: Level
    sentence: str


def ok(name: str, sentence: str) -> Verdict:
    """All is as it must be."""
    return Verdict(name, Level.OK, sentence)


def warning(name: str, sentence: str) -> Verdict:
    """Not as it should be, or not known."""
    return Verdict(name, Level.WARNING, sentence)


def fail(name: str, sentence: str) -> Verdict:
    """No go."""
    return Verdict(name, Level.FAIL, sentence)


def is_go(verdicts: Iterable[Verdict]) -> bool:
    """Whether nothing forbids the flight."""
    return all(verdict.level is not Level.FAIL for verdict in verdicts)
