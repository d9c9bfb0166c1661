"""Counters of a node: totals, and inputs that it rejected, by reason.

Source: ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any


class Counters(Mapping[str, int]):
    """Totals since the start, by name, and the number of rejected inputs, by reason.

    As a mapping, for people and files, it has the totals by their names and the rejected inputs by `rejected: reason`.
    """

    __slots__ = ("_all", "rejected", "totals")

    def __init__(self, totals: Mapping[str, int] | None = None, rejected: Mapping[str, int] | None = None) -> None:
        self.totals: dict[str, int] = dict(totals or {})
        self.rejected: dict[str, int] = dict(rejected or {})
        self._all = self.totals | {f"rejected: {reason}": count for reason, count in self.rejected.items()}

    @staticmethod
    def of(counts: Mapping[str, int]) -> Counters:
        """The counters of a node at this time; a plain mapping has totals only."""
        return counts if isinstance(counts, Counters) else Counters(counts)

    def __getitem__(self, name: str) -> int:
        return self._all[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def __add__(self, other: Counters) -> Counters:
        """The sums of both that are positive."""
        return Counters(Counter(self.totals) + Counter(other.totals), Counter(self.rejected) + Counter(other.rejected))

    def __repr__(self) -> str:
        return f"Counters({self._all})"

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `of_json`."""
        return {"totals": self.totals, "rejected": self.rejected}

    @staticmethod
    def of_json(values: dict[str, Any]) -> Counters:
        """The counters that `to_json` wrote."""
        return Counters(values["totals"], values["rejected"])
