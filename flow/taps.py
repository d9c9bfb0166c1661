"""The output hash of a run.

Source: ours.
"""

from __future__ import annotations

import hashlib
from typing import Any

from flow.link import Tap
from flow.message import Message, hash_into
from flow.stage import Settings


class Digest(Tap):
    """The output hash of a run: every message of every output, each output's in order. Equal for two equal runs.

    It has two halves, `values-texts`: all values, and the texts for people. Neither depends on the names of classes,
    fields, nodes and outputs. How messages of different outputs interleave does not matter, so that a live run, in
    which many threads publish, and its repetition have one hash. Threads may call `see` at the same time, for
    different outputs.
    """

    def __init__(self, settings: Settings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._hashes: dict[str, tuple[str, Any, Any]] = {}
        self._joined: dict[str, str] = {}

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Hash the run's clock and the whole message."""
        known = self._hashes.get(output)
        if known is None:
            hashers = (
                hashlib.sha256(),
                hashlib.sha256(),
            )  # twice as fast as blake2b where the CPU has instructions for it
            known = self._hashes[output] = (type(message).schema, *hashers)
        _, values, texts = known
        hash_into(values, texts, message, b"@%d" % arrival_ns)

    @property
    def outputs(self) -> dict[str, str]:
        """Each output's message type and hashes so far: `schema values texts`."""
        seen = {
            name: f"{schema} {values.hexdigest()} {texts.hexdigest()}"
            for name, (schema, values, texts) in self._hashes.items()
        }
        return seen | self._joined

    def join(self, outputs: dict[str, str]) -> None:
        """Take in the outputs that another digest saw."""
        self._joined |= outputs

    def hexdigest(self) -> str:
        """`values-texts`, 16 hex digits each."""
        outputs = [hashes.split(" ") for hashes in self.outputs.values()]
        halves = ((schema, values) for schema, values, _ in outputs), ((schema, texts) for schema, _, texts in outputs)
        return "-".join(hashlib.blake2b(repr(sorted(half)).encode(), digest_size=8).hexdigest() for half in halves)
