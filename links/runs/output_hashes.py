"""Pinned output hashes of the committed recordings under each configuration, in `recordings/hashes.json`.

    {"street_sweep.mcap": {"replay": "0123456789abcdef-fedcba9876543210", ...}, ...}

The half before the dash covers every value of every message, the half after it the texts for people (`flow.taps`).

Source: ours; openpilot's process replay has reference hashes for the same purpose.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from flow.config.yaml_text import YamlTextError, yaml_values
from flow.link import TRUTH_TOPICS, LinkError, Tap
from flow.replay import replay
from flow.taps import Digest
from links.recording import Session
from links.runs.request import RunRequest

HASHES_FILE = "hashes.json"
CONFIGS = ("replay", "paper", "estimate")  # of configs/; pinned for every recording
CAMERA_CONFIGS = ("vision",)  # also pinned for recordings with cameras
HASH_FORM = "16 hex digits, a dash and 16 hex digits"


@dataclass(frozen=True, slots=True)
class Pin:
    """The output hash that one recording has under one configuration; None: not pinned."""

    recording: Path
    config: Path
    expected: str | None


@dataclass(frozen=True, slots=True)
class PinResult:
    """A pin and the output hash of its replay."""

    pin: Pin
    actual: str

    @property
    def values_match(self) -> bool:
        """Whether every value of every message is as pinned."""
        return self.pin.expected is not None and values_half(self.pin.expected) == values_half(self.actual)

    @property
    def matches(self) -> bool:
        """Whether values and texts are as pinned."""
        return self.pin.expected == self.actual


def values_half(output_hash: str) -> str:
    """The half of an output hash that covers values."""
    return output_hash.partition("-")[0]


def hash_matches(expected: str, actual: str) -> bool:
    """Whether a run has an expected hash: a whole one, or the half that covers values. LinkError for anything else."""
    if not expected or len(expected) not in (16, 33) or set(expected) - set("0123456789abcdef-"):
        raise LinkError(f"'{expected}' is not an output hash: give {HASH_FORM}, or the first 16 for the values alone")
    return expected == (actual if "-" in expected else values_half(actual))


def read_pins(folder: Path, configs: Path, only: tuple[str, ...] = ()) -> list[Pin]:
    """The pins of a folder of recordings, including those missing in its `hashes.json`.

    `only`: names of recordings, without `.mcap`. LinkError for an unknown name or a damaged file.
    """
    recordings = sorted(folder.glob("*.mcap"))
    known = {file.stem for file in recordings}
    if unknown := sorted(set(only) - known):
        raise LinkError(f"no recording '{unknown[0]}' in {folder}; there is {', '.join(sorted(known)) or 'none'}")
    pinned = _read(folder / HASHES_FILE)
    return [
        Pin(file, configs / f"{name}.yaml", pinned.get(file.name, {}).get(name))
        for file in recordings
        if not only or file.stem in only
        for name in (*CONFIGS, *(CAMERA_CONFIGS if _has_cameras(file) else ()))
    ]


def write_pins(folder: Path, outcomes: list[PinResult]) -> None:
    """Pin the measured hashes; pins of other recordings stay."""
    pinned = _read(folder / HASHES_FILE)
    for outcome in outcomes:
        pinned.setdefault(outcome.pin.recording.name, {})[outcome.pin.config.stem] = outcome.actual
    text = json.dumps(pinned, indent=2, sort_keys=True)
    (folder / HASHES_FILE).write_text(text + "\n", encoding="utf-8")


def measure(pins: list[Pin], jobs: int) -> Iterator[PinResult]:
    """Replay each pin, `jobs` at a time; outcomes in order of completion. Raises the errors of a replay."""
    if jobs == 1:
        yield from (PinResult(pin, output_hash(pin.recording, pin.config)) for pin in pins)
        return
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(output_hash, pin.recording, pin.config): pin for pin in pins}
        for future in as_completed(futures):
            yield PinResult(futures[future], future.result())


def output_hash(recording: Path, config: Path) -> str:
    """Replay a recording through a configuration without its taps, in one process, every array checked."""
    session = Session(recording)
    graph = RunRequest(config, sets=_without_taps(config)).graph_on(session)
    digest = Digest()
    records = (record for record in session.records() if not record.topic.startswith(TRUTH_TOPICS))
    replay(graph, records, [digest], strict=True)
    return digest.hexdigest()


def _without_taps(config: Path) -> tuple[str, ...]:
    """Settings that disable the taps of a configuration: the viewer takes half the time of a replay."""
    nodes = RunRequest(config).graph().nodes.values()
    return tuple(f"links.{spec.name}=null" for spec in nodes if issubclass(spec.cls, Tap))


def _has_cameras(recording: Path) -> bool:
    try:
        rig = yaml_values(Session(recording).rig_yaml or "")
    except YamlTextError as error:
        raise LinkError(f"{recording} (rig.yaml): {error}") from None
    return isinstance(rig, dict) and bool(rig.get("cameras"))


def _read(file: Path) -> dict[str, dict[str, str]]:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise LinkError(f"{file} is not JSON: {error}") from None
