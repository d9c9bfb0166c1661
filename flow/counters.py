"""Counters of a node: totals, and counts by name in groups, such as rejected inputs by reason.

Source: ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

REJECTED = "rejected"


class Counters(Mapping[str, int]):
    """Totals since the start, by name, and groups of counts: `rejected` inputs by reason, and others.

    As a mapping, for people and files, it has the totals by their names and the groups' counts by `group: name`.
    """

    __slots__ = ("_all", "groups", "totals")

    def __init__(
        self,
        totals: Mapping[str, int] | None = None,
        rejected: Mapping[str, int] | None = None,
        groups: Mapping[str, Mapping[str, int]] | None = None,
    ) -> None:
        self.totals: dict[str, int] = dict(totals or {})
        given = {name: dict(counts) for name, counts in (groups or {}).items()}
        self.groups: dict[str, dict[str, int]] = given | ({REJECTED: dict(rejected)} if rejected else {})
        grouped = {f"{group}: {name}": n for group, counts in self.groups.items() for name, n in counts.items()}
        self._all = self.totals | grouped

    @property
    def rejected(self) -> dict[str, int]:
        """The number of rejected inputs, by reason."""
        return self.groups.get(REJECTED, {})

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
        groups = {
            name: Counter(self.groups.get(name, {})) + Counter(other.groups.get(name, {}))
            for name in (*self.groups, *(name for name in other.groups if name not in self.groups))
        }
        return Counters(Counter(self.totals) + Counter(other.totals), groups=groups)

    def __repr__(self) -> str:
        return f"Counters({self._all})"

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `of_json`."""
        return {"totals": self.totals, "groups": self.groups}

    @staticmethod
    def of_json(values: dict[str, Any]) -> Counters:
        """The counters that `to_json` wrote."""
        return Counters(values["totals"], groups=values["groups"])
