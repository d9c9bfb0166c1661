"""Judges one output of one run: every metric of the catalogue, what was found wrong, and what could not be judged.

Source: DESIGN, evaluate.
"""

from __future__ import annotations

from links.evaluation.accuracy import at_own_stamps, over_all_time, timing
from links.evaluation.both_cameras import both_cameras
from links.evaluation.catalogue import CATALOGUE, Value
from links.evaluation.consistency import covariance, rotation
from links.evaluation.errors import GRID_NS, AtOutputs, Limits, OverTime, at_outputs, over_time, span_of
from links.evaluation.faults import false_outputs
from links.evaluation.for_autopilot import for_autopilot
from links.evaluation.judged import Evaluation
from links.evaluation.keeping import keeping
from links.evaluation.output import Output
from links.evaluation.run_data import RunData
from links.evaluation.searches import detections


def evaluate(run: RunData, output: Output, limits: Limits | None = None) -> Evaluation:
    """Judge an output. Every metric has a value or a reason afterwards."""
    limits = limits or Limits()
    span, whence = span_of(run)
    judged = Evaluation(run, output, limits, span)
    if span is None:
        judged.remarks.append(whence)
    else:
        judged.remarks.append(f"judged over {(span[1] - span[0]) / 1e9:.2f} s, the span of {whence}")
    if run.truth is not None and not run.no_drone:
        judged.at = at_outputs(output, run.truth, limits)
        if span is not None:
            judged.over = over_time(output, run.truth, span, limits)
        _tell_left_out(judged, judged.at, judged.over)
    timing(judged)
    over_all_time(judged)
    at_own_stamps(judged)
    keeping(judged)
    false_outputs(judged)
    detections(judged)
    for_autopilot(judged)
    rotation(judged)
    both_cameras(judged)
    covariance(judged)
    _compute(judged)
    order = [*CATALOGUE, *(key for key in judged.values if key not in CATALOGUE)]
    judged.values = {key: judged.values[key] for key in order}
    return judged


def _tell_left_out(judged: Evaluation, at: AtOutputs, over: OverTime | None) -> None:
    if at.unknown:
        judged.remarks.append(
            f"{at.unknown} of {len(judged.output.poses)} outputs have no truth within "
            f"{judged.limits.max_gap_s:g} s on both sides; they are in no error"
        )
    if over is None or judged.span_ns is None:
        return
    if len(over.away_ns):
        judged.remarks.append(
            f"for {len(over.away_ns) * GRID_NS / 1e9:.1f} s the drone was beyond {judged.limits.reach_m:g} m; no "
            "output is asked for then"
        )
    moments = (judged.span_ns[1] - judged.span_ns[0]) // GRID_NS + 1
    dark = moments - len(over.at_ns) - len(over.away_ns)
    if dark > 1:
        judged.remarks.append(f"for {dark * GRID_NS / 1e9:.2f} s of it there is no truth; nothing is judged then")


def _compute(judged: Evaluation) -> None:
    span_ms = None if judged.span_ns is None else (judged.span_ns[1] - judged.span_ns[0]) / 1e6
    for stage, times in judged.run.compute_ms.items():
        for what in ("p50", "p99"):
            judged.values[f"compute_{stage}_{what}"] = Value(float(times[what]), int(times["calls"]))
        if span_ms and "total" in times:
            judged.values[f"compute_{stage}_load"] = Value(100 * float(times["total"]) / span_ms)
    if not judged.run.compute_ms:
        why = judged.run.missing.get("compute", "summary.json holds none")
        judged.remarks.append(f"compute time per stage not evaluated: {why}")
