"""Table of the first fix with and without each cue, and of false acceptances with wrong cues.

    python -m links.simulated.matrix.cue_table OUT --only 'campus-20m-hover-parked' --seeds 2
    python -m links.simulated.matrix.cue_table OUT --pairs --only '*-20m-[!r]*' --only '*-30m-*'

Each flight is simulated in closed loop with configs/cues.yaml, without the fusion, up to `AFTER_S` after its first fix.
First fix: the first DroneFix within NEAR_M of the drone. False acceptance: a candidate that the detector accepts
farther than NEAR_M from every drone; `by_cues` when it would not have been accepted without what the cues add.
Exposed (flights without cues): a candidate that is no drone, not accepted, but
so probable that a cue with the largest sum, placed exactly on it, would have it accepted. OUT/flights.jsonl has a line
for each flight; flights in it are not repeated.

Source: ours.
"""

from __future__ import annotations

import itertools
import math
import re
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import LinkError, Tap
from flow.message import Message
from links.runs.request import RunRequest
from links.runs.shipped import shipped
from links.simulated.matrix.flight_lines import CellFlight, flights_parser, flown, write_table
from links.simulated.matrix.flights import CAMERA_HEIGHT_M
from links.simulated.matrix.matrix import Conditions, cells, scenario_of
from links.simulated.rig.closed_loop import ClosedLoop
from links.simulated.rig.run import Simulation
from links.simulated.world.scene import Truth
from stages.cues.evidence import CueWeights
from stages.detect.candidate_cues import CUE_PASSES
from stages.detect.candidate_messages import log_odds_of
from stages.messages import CandidateEvidence, CandidateLog, CueState, Detections, DroneFix

NEAR_M = 1.0  # as `grd evaluate`
ACCEPT_NATS = log_odds_of(0.95)  # `accept_probability` of the detector
AFTER_S = 2.0
CUES_ADD = re.compile(r"; cues ([+-][0-9.]+)")  # in the reason of a candidate
GNSS: dict[str, Any] = {"drone": {}, "vehicle": {"heading_sigma_deg": 2.0}}
NO_HEADING: dict[str, Any] = {"drone": {}, "vehicle": {}}
RANGING: dict[str, Any] = {"ranging": {}}
ALL = {**GNSS, **RANGING, "barometer": {}}
OFF_M = {"offset_world_m": (21.2, -21.2, 0.0)}  # 30 m
VARIANTS: dict[str, dict[str, Any] | None] = {
    "none": None,
    "gnss": GNSS,
    "gnss, no heading": NO_HEADING,
    "uwb": RANGING,
    "altitude": {"drone": {}, "barometer": {}},
    "all": ALL,
    "wrong: gnss 30 m off": {**GNSS, "drone": OFF_M},
    "wrong: gnss 30 m off, uwb true": {**GNSS, **RANGING, "drone": OFF_M},
    "wrong: uwb 15 m off": {"ranging": {"offset_m": 15.0}},
    "wrong: all of another drone": {
        "drone": {"of_drone": 2},
        "vehicle": {"heading_sigma_deg": 2.0},
        "ranging": {"of_drone": 2},
        "barometer": {},
    },
}
CONFIG = Path("configs/cues.yaml")
SETS = (
    "stages.fuse=null",
    "links.viewer=null",
    f"stages.cues.config.altitude.home_up_m={-CAMERA_HEIGHT_M}",
)


class AcceptanceTap(Tap):
    """First fix and acceptances of a run, compared with the truth."""

    def __init__(self) -> None:
        super().__init__()
        self.truth: Truth | None = None
        self.first_fix_s: float | None = None
        self.first_drone: int | None = None  # number of the drone of the first fix near any drone
        self.false: list[dict[str, Any]] = []
        self.accepted: set[tuple[int, bool]] = set()
        self.exposed: set[int] = set()
        self.reported_s: float | None = None  # a cue was reported as not trusted

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Take one message."""
        if isinstance(message, DroneFix):
            self._on_fix(message)
        elif isinstance(message, Detections) and isinstance(message.evidence, CandidateEvidence):
            self._on_detections(message, message.evidence)
        elif isinstance(message, CandidateLog):
            self._on_candidates(message)
        elif isinstance(message, CueState) and not message.trusted and self.reported_s is None:
            self.reported_s = self._seconds(message.stamp_ns)

    def _seconds(self, stamp_ns: int) -> float:
        assert self.truth is not None
        return (stamp_ns - self.truth.start_ns) * 1e-9

    def distances_m(self, stamp_ns: int, xyz_vehicle_m: Any) -> list[float]:
        """Distance of a position from each drone."""
        truth, at = self.truth, np.array([stamp_ns])
        assert truth is not None
        R, t = (part[0] for part in truth.T_world_vehicle(at))
        xyz_m = R @ xyz_vehicle_m + t
        return [float(np.linalg.norm(truth.T_world_drone(at, number)[1][0] - xyz_m)) for number in truth.drones]

    def _on_fix(self, fix: DroneFix) -> None:
        distances_m = self.distances_m(fix.stamp_ns, fix.xyz_vehicle_m)
        nearest = int(np.argmin(distances_m))
        if distances_m[nearest] > NEAR_M:
            return
        self.first_drone = self.first_drone or nearest + 1
        if nearest == 0 and self.first_fix_s is None:
            self.first_fix_s = self._seconds(fix.stamp_ns)

    def _on_candidates(self, log: CandidateLog) -> None:
        passes = log.features[:, log.feature_names.index("scan_passes")]
        for i in np.flatnonzero((log.probability > 0.0) & (log.probability < 1.0) & (passes >= CUE_PASSES)).tolist():
            nats = log_odds_of(float(log.probability[i]))
            if ACCEPT_NATS - CueWeights().max_sum <= nats < ACCEPT_NATS:
                distances_m = self.distances_m(int(log.seen_ns[i]), log.xyz_vehicle_m[i])
                if not distances_m or min(distances_m) > NEAR_M:
                    self.exposed.add(int(log.candidate_id[i]))

    def _on_detections(self, message: Detections, evidence: CandidateEvidence) -> None:
        for i in np.flatnonzero(message.accepted).tolist():
            number, seen_ns = int(evidence.candidate_id[i]), int(evidence.seen_ns[i])
            distances_m = self.distances_m(seen_ns, message.xyz_vehicle_m[i])
            is_false = not distances_m or min(distances_m) > NEAR_M
            if is_false and (number, True) not in self.accepted:
                self.false.append(
                    {
                        "s": self._seconds(seen_ns),
                        "m": distances_m,
                        "by_cues": by_cues(float(evidence.log_odds[i]), message.reasons[i]),
                        "why": message.reasons[i],
                    }
                )
            self.accepted.add((number, is_false))


def by_cues(log_odds: float, reason: str) -> bool:
    """Whether an accepted candidate is below the threshold without what the cues add, by its reason."""
    cues = CUES_ADD.search(reason)
    return cues is not None and log_odds - float(cues[1]) < ACCEPT_NATS


def fly(flight: CellFlight[str], progress: Callable[[float], None]) -> dict[str, Any] | None:
    """Simulate one flight. None: the scene of the seed does not allow it."""
    cues = VARIANTS[flight.variant]
    conditions = Conditions(autopilot=True, odometry=True, calibrated=True, sparse=True, varied_sky=True)
    try:
        scenario = scenario_of(flight.cell, flight.seed, conditions).changed(cues=cues)
    except LinkError:
        return None
    graph = RunRequest(shipped(CONFIG), sets=SETS).graph(scenario.rig_yaml(), "the rig")
    tap = AcceptanceTap()
    simulation = Simulation(scenario, loop=ClosedLoop(graph, scenario.closed_loop, {}, [tap]), record_truth=False)
    tap.truth = simulation.truth
    for record in simulation.records():
        now_s = (record.arrival_ns - scenario.start_ns) * 1e-9
        progress(now_s / scenario.duration_s)
        if tap.first_fix_s is not None and now_s > tap.first_fix_s + AFTER_S:
            break
    found = {"first_fix_s": tap.first_fix_s, "first_drone": tap.first_drone, "reported_s": tap.reported_s}
    return {
        "cell": flight.name,
        "seed": flight.seed,
        "variant": flight.variant,
        **found,
        "false": tap.false,
        "exposed": len(tap.exposed),
    }


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: by range and variant, flights, median and slowest first fix, false acceptances, wrong first drones."""
    lines = ["| range | cues | flights | found | median first fix [s] | slowest [s] | false (by cues) | reported |"]
    lines.append("| --- | --- | --- | --- | --- | --- | --- | --- |")
    by_range = sorted({range_of(row["cell"]) for row in rows}, key=int)
    for range_m, variant in itertools.product(by_range, VARIANTS):
        of = [row for row in rows if range_of(row["cell"]) == range_m and row["variant"] == variant]
        if not of:
            continue
        first_s = [row["first_fix_s"] if row["first_fix_s"] is not None else math.inf for row in of]
        false = list(itertools.chain.from_iterable(row["false"] for row in of))
        by = sum(one["by_cues"] for one in false)
        found = sum(map(math.isfinite, first_s))
        reported = sum(row["reported_s"] is not None for row in of)
        times = f"{found} | {statistics.median(first_s):.2f} | {max(first_s):.2f}"
        lines.append(f"| {range_m} m | {variant} | {len(of)} | {times} | {len(false)} ({by}) | {reported} |")
    exposed = [row["exposed"] for row in rows if row["variant"] == "none"]
    lines.append(
        f"\nExposed to a cue exactly on them: {sum(exposed)} candidates in {len(exposed)} flights without cues."
    )
    two = [row for row in rows if "-two-" in row["cell"]]
    for variant in VARIANTS:
        of = [row["first_drone"] for row in two if row["variant"] == variant]
        if of:
            lines.append(
                f"\nTwo drones, {variant}: the first fix is on the drone of the cues in {of.count(1)} of {len(of)}"
            )
    return "\n".join(lines)


def range_of(cell: str) -> str:
    """`20` of `campus-20m-hover-parked`."""
    return cell.split("-")[1].removesuffix("m")


def main() -> None:
    """The command."""
    parser = flights_parser(__doc__)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    arguments = parser.parse_args()
    flights = [
        CellFlight(cell, seed, variant)
        for cell in cells(arguments.only or ["*"], arguments.pairs)
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        for variant in arguments.variants
        if "another" not in variant or cell.motion == "two"
    ]
    write_table(arguments.folder, table_of(flown(arguments.folder, flights, fly, arguments.jobs)))


if __name__ == "__main__":
    main()
