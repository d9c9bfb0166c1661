"""Run folders with metrics known by hand: the files that `grd replay` writes, made of arrays; and their evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from links.evaluation.association import EvaluationLimits
from links.evaluation.evaluation import Evaluation
from links.evaluation.metrics import evaluate
from links.evaluation.run_data import per_drone, read_run

START_S = 1_748_773_230
SECOND = 1_000_000_000
START_NS = START_S * SECOND


def evaluated(
    folder: Path, truth: Path | None = None, no_drone: bool = False, which: int = 0, limits=None
) -> Evaluation:
    """The evaluation of one output of a run, the primary one by default."""
    run = read_run(folder, truth, no_drone)
    return evaluate(run, run.outputs[which], limits)


def all_evaluated(*folders: Path) -> list[Evaluation]:
    """The evaluations of all outputs of all drones of several runs."""
    runs = [run for folder in folders for run in per_drone(read_run(folder), EvaluationLimits())]
    return [evaluate(run, output) for run in runs for output in run.outputs]


def value(e: Evaluation, key: str) -> float:
    """The value of a metric that has one."""
    found = e.values[key]
    assert found.value is not None, (key, found.note)
    return found.value


def stamp(t_s: float) -> str:
    ns = START_NS + round(t_s * 1e9)
    return f"{ns // SECOND}.{ns % SECOND:09d}"


def truth_at(t_s: np.ndarray) -> np.ndarray:
    """A drone 12 m up that flies along x at 1 m/s: linear, so interpolation is exact."""
    return np.column_stack([1.0 * t_s, np.full(len(t_s), 3.0), np.full(len(t_s), 12.0)])


def lines(t_s, xyz, quaternions=None) -> str:
    q = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)) if quaternions is None else quaternions
    rows = [
        f"{stamp(t)} " + " ".join(f"{v:.9f}" for v in (*p, *o)) for t, p, o in zip(t_s, np.asarray(xyz), q, strict=True)
    ]
    return "".join(f"{row}\n" for row in rows)


def make_run(
    folder: Path,
    t_s,
    xyz,
    *,
    sigma_m: float | np.ndarray | None = 0.1,
    duration_s: float = 10.0,
    recording: str = "flight",
    truth: np.ndarray | str | None = None,
    truth_step_s: float = 0.01,
    sweeps: list[tuple[float, float, list[list[float]]]] | None = None,
    hits_s: list[float] | None = None,
    compute_ms: dict | None = None,
    states: list[tuple] = (),
    tracks: list[int] | np.ndarray | None = None,
    visible: list[tuple[float, int]] | None = None,
    config: str = "",
    sets: list[str] = (),
) -> Path:
    """A run with fixes at `t_s`. `truth` "no drone" or "none" leaves it out; default: `truth_at` over the whole recording."""
    folder.mkdir(parents=True)
    t_s, xyz = np.asarray(t_s, dtype=float), np.asarray(xyz, dtype=float).reshape(-1, 3)
    (folder / "fix_vehicle_drone.tum").write_text("# T_vehicle_drone, position only\n" + lines(t_s, xyz))
    if sigma_m is not None:
        variances = np.broadcast_to(np.asarray(sigma_m, dtype=float), len(t_s)) ** 2
        ends = [""] * len(t_s) if tracks is None else [f",{track}" for track in tracks]
        rows = [f"{stamp(t)},{v},0,0,{v},0,{v},5,3{end}\n" for t, v, end in zip(t_s, variances, ends, strict=True)]
        head = f"stamp_s,cxx_m2,cxy_m2,cxz_m2,cyy_m2,cyz_m2,czz_m2,returns,iterations{'' if tracks is None else ',track_id'}\n"
        (folder / "fix_covariance.csv").write_text(head + "".join(rows))
    if isinstance(truth, str):
        if truth == "no drone":
            (folder / "truth_vehicle_drone.tum").write_text("# no drone in this recording\n")
    else:
        times = np.arange(0, duration_s + truth_step_s / 2, truth_step_s)
        path = truth_at(times) if truth is None else truth
        (folder / "truth_vehicle_drone.tum").write_text("# T_vehicle_drone, full pose, truth\n" + lines(times, path))
    if sweeps is not None:
        text = "start_s,end_s,x_m,y_m,z_m,score\n"
        for start, end, accepted in sweeps:
            for cells in accepted or [["", "", ""]]:
                score = "1" if accepted else ""
                text += ",".join([stamp(start), stamp(end), *map(str, cells), score]) + "\n"
        (folder / "detections.csv").write_text(text)
    if visible is not None:
        rows = "".join(f"{stamp(t)},{seen}\n" for t, seen in visible)
        (folder / "truth_visible.csv").write_text(f"stamp_s,visible\n{rows}")
    if hits_s is not None:
        (folder / "truth_returns.csv").write_text("stamp_s\n" + "".join(f"{stamp(t)}\n" for t in hits_s))
    summary = {
        "recording": f"{recording}.mcap",
        "start_s": stamp(0.0),
        "end_s": stamp(duration_s),
        "states": [
            {"stamp_s": stamp(t), "state": state, "reason": ""} | ({"track_id": track[0]} if track else {})
            for t, state, *track in states
        ],
        "compute_ms": compute_ms or {},
        "config": f"{config}.yaml",
        "overlays": [],
        "set": list(sets),
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def add_pose(
    folder: Path, t_s, xyz, quaternions, covariance: np.ndarray | None, good: np.ndarray | None = None
) -> None:
    """Add the fused pose with its 6x6 covariance to a run."""
    (folder / "pose_vehicle_drone.tum").write_text(lines(t_s, xyz, quaternions))
    if covariance is None:
        return
    names = [f"c{a}{b}" for a in range(6) for b in range(a, 6)]
    text = ",".join(["stamp_s", *names, *(["accepted"] if good is not None else [])]) + "\n"
    for i, t in enumerate(t_s):
        cells = [f"{v:.12g}" for v in covariance[np.triu_indices(6)]]
        text += ",".join([stamp(t), *cells, *([str(int(good[i]))] if good is not None else [])]) + "\n"
    (folder / "pose_covariance.csv").write_text(text)


def yaw_quaternion(yaw_rad) -> np.ndarray:
    half = np.asarray(yaw_rad, dtype=float) / 2
    return np.column_stack([0 * half, 0 * half, np.sin(half), np.cos(half)])


def add_rotations(
    folder: Path,
    t_s,
    quaternions,
    *,
    variance_rad2=(1e-4, 1e-4, 1e-4),
    accepted=True,
    resolved=False,
    switches=0,
    undecided="AMBIGUOUS",
) -> Path:
    """Add the rotation by both cameras at `t_s`, with a covariance along the drone's axes."""
    n = len(t_s)
    accepted, resolved, switches = (np.broadcast_to(flags, n) for flags in (accepted, resolved, switches))
    rows = ["stamp_s,accepted,qx,qy,qz,qw,cxx_rad2,cxy_rad2,cxz_rad2,cyy_rad2,cyz_rad2,czz_rad2,state,switches,reason"]
    for i, t in enumerate(t_s):
        xx, yy, zz = variance_rad2
        numbers = [*(f"{v:.12g}" for v in quaternions[i]), *map(str, (xx, 0, 0, yy, 0, zz))]
        state = ("RESOLVED" if resolved[i] else undecided) if accepted[i] else "NONE"
        cells = [stamp(t), str(int(accepted[i])), *(numbers if accepted[i] else [""] * 10), state, str(switches[i])]
        rows.append(",".join([*cells, '"lines, few"']))
    (folder / "rotation_vehicle_drone.csv").write_text("\n".join(rows) + "\n")
    return folder


def add_true_rotations(folder: Path, drone, vehicle=None, vehicle_xyz=None, duration_s: float = 10.0) -> Path:
    """Truth, linear in time as `truth_at`: quaternions of the drone in the vehicle, and of the vehicle in the world.

    Each is one quaternion, or one each 0.01 s.
    """
    times = np.arange(0, duration_s + 0.005, 0.01)
    q = np.broadcast_to(drone, (len(times), 4))
    (folder / "truth_vehicle_drone.tum").write_text("# full pose\n" + lines(times, truth_at(times), q))
    if vehicle is not None:
        xyz = np.zeros((len(times), 3)) if vehicle_xyz is None else vehicle_xyz(times)
        q = np.broadcast_to(vehicle, (len(times), 4))
        (folder / "truth_world_vehicle.tum").write_text("# full pose\n" + lines(times, xyz, q))
    return folder
