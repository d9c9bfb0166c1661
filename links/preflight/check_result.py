"""The result of one preflight check: a name, a level, and a sentence with the finding and what to do about it."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass


class Level(enum.Enum):
    """Severity of a result. The operator decides about a warning; only a failure forbids the flight."""

    OK = "ok"
    WARNING = "warning"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check."""

    name: str
    level: Level
    sentence: str


def ok(name: str, sentence: str) -> CheckResult:
    """A check that passed."""
    return CheckResult(name, Level.OK, sentence)


def warning(name: str, sentence: str) -> CheckResult:
    """A check that found a degraded or unknown state."""
    return CheckResult(name, Level.WARNING, sentence)


def fail(name: str, sentence: str) -> CheckResult:
    """A check that forbids the flight."""
    return CheckResult(name, Level.FAIL, sentence)


def is_go(results: Iterable[CheckResult]) -> bool:
    """Whether no result forbids the flight."""
    return all(result.level is not Level.FAIL for result in results)
