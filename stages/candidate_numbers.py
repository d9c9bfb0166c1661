"""Whether the detector counts its candidates anew: one that was started afresh begins at 1 again.

The looks at a candidate never grow fewer: a number heard with fewer looks than before is another thing's.

Source: ours.
"""

from __future__ import annotations

from stages.messages import Candidates

KEPT = 1024


class CandidateNumbers:
    """The looks at each candidate, by its number."""

    def __init__(self) -> None:
        self._looks: dict[int, int] = {}

    def hear(self, candidates: Candidates) -> bool:
        """Whether numbers heard before mean other things from now on."""
        told = dict(zip(candidates.candidate_id.tolist(), candidates.looks.tolist(), strict=True))
        anew = any(looks < self._looks.get(number, 0) for number, looks in told.items())
        if anew:
            self._looks.clear()
        for number, looks in told.items():
            self._looks.pop(number, None)
            self._looks[number] = looks  # the newest last
        while len(self._looks) > KEPT:
            del self._looks[next(iter(self._looks))]
        return anew
