"""Errors in a configuration: all of them at once, each at file:line, with a suggestion where one is near.

Source: ours; tests/flow/config/test_check.py pins the wording.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass

from flow.config.secrets import without_secrets


@dataclass(frozen=True, slots=True)
class Location:
    """Where a value is written: file as the user named it, line from 1; line 0 is the whole file, or an option."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass(frozen=True, slots=True)
class ErrorDetail:
    """One error: where, in which setting, what is wrong and what to do. Its text has no secrets."""

    location: Location
    path: str  # stages.track.inputs.sweep
    text: str

    def __str__(self) -> str:
        parts = (str(self.location), self.path, self.text)
        return without_secrets(": ".join(part for part in parts if part))


class ConfigError(Exception):
    """A configuration cannot be run. `errors` holds every error that was found."""

    def __init__(self, errors: Iterable[ErrorDetail]) -> None:
        self.errors = tuple(errors)
        super().__init__("\n".join(str(error) for error in self.errors))

    @classmethod
    def in_order(cls, errors: Iterable[ErrorDetail]) -> ConfigError:
        """One of these errors without repetitions, in the order of the files' lines."""
        unique = dict.fromkeys(errors)
        return cls(sorted(unique, key=lambda error: (error.location.file, error.location.line)))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` Did you mean 'x'?` for the most similar known word, or nothing."""
    found = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" Did you mean '{found[0]}'?" if found else ""


def one_of(known: Iterable[str]) -> str:
    """`'a', 'b' or 'c'`, for errors that list what exists."""
    words = [f"'{word}'" for word in known]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}" if words else "nothing"
