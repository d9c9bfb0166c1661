"""Draw the figures of the documents: `python docs/figures.py` (needs the extra `evaluate`).

`images/frames.svg` is the frames figure. `images/replay.gif` is made from the committed recording
`recordings/street_sweep.mcap`, replayed with `configs/estimate.yaml`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parents[1]
IMAGES = Path(__file__).resolve().parent / "images"
TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]


def main() -> None:
    """Draw all figures."""
    draw_frames(IMAGES / "frames.svg")
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "-c", "from links.cli import main; main()", "replay", "recordings/street_sweep.mcap"]
        options = ["--config", "configs/estimate.yaml", "--set", "detect.parked=true", "--out", str(run)]
        options += ["--set", "detect.accept_probability=0.5"]  # nothing is known of this drone
        subprocess.run([*command, *options], cwd=ROOT, check=True)
        animate_replay(run, IMAGES / "replay.gif")


def draw_frames(file: Path) -> None:
    """Vehicle, turntable, lidar, drone, map and odom, each with its axes; and FLU next to FRD and NED."""
    figure, axes = plt.subplots(figsize=(9.5, 4.2))
    axes.set(xlim=(-0.5, 12.5), ylim=(-0.9, 5.4), aspect="equal")
    axes.axis("off")
    axes.plot([-0.5, 8.3], [0, 0], color="0.6", lw=1)
    axes.add_patch(plt.Rectangle((2.2, 0.15), 3.0, 0.9, fc="0.92", ec="0.5"))
    for x in (2.8, 4.6):
        axes.add_patch(plt.Circle((x, 0.15), 0.22, fc="0.75", ec="0.5"))
    axes.add_patch(plt.Rectangle((3.35, 1.05), 0.5, 0.3, fc="0.8", ec="0.5"))
    axes.plot([6.3, 7.5], [4.2, 4.2], color="0.4", lw=3)
    axes.annotate("", (6.75, 4.0), (3.7, 1.8), arrowprops={"arrowstyle": "->", "ls": "--", "color": "0.4"})
    axes.text(5.35, 2.65, "$T_{vehicle,drone}$", color="0.3")
    _frame(axes, 0.3, 0.0, "map", "vehicle start")
    _frame(axes, 4.75, 1.05, "vehicle", "FLU, at the vehicle camera")
    _frame(axes, 3.6, 1.35, "turntable, lidar", "turns with the servo", left=True)
    _frame(axes, 6.9, 4.2, "drone", "FLU, at the body")
    _frame(axes, 7.2, 0.0, "odom", "autopilot's local frame")
    for row, (name, labels) in enumerate(
        (("FLU", "x forward, y left, z up"), ("FRD", "x forward, y right, z down"), ("NED", "x north, y east, z down"))
    ):
        axes.text(9.4, 4.6 - 0.55 * row, name, weight="bold")
        axes.text(10.1, 4.6 - 0.55 * row, labels, fontsize=8)
    axes.text(
        9.4,
        2.75,
        "FLU everywhere in grd;\nFRD and NED only in links/mavlink:\nF = diag(1, -1, -1)",
        fontsize=8,
        va="top",
    )
    axes.text(9.4, 1.4, "$p_a = T_{a,b}\\, p_b$", fontsize=11)
    figure.savefig(file, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


def _frame(axes: Axes, x: float, y: float, name: str, note: str, *, left: bool = False) -> None:
    """One frame: x in red to the right, z in blue upwards, its name and a note."""
    for dx, dy, colour, letter in ((0.75, 0.0, "tab:red", "x"), (0.0, 0.75, "tab:blue", "z")):
        axes.annotate("", (x + dx, y + dy), (x, y), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})
        axes.text(x + 1.15 * dx, y + 1.15 * dy, letter, color=colour, ha="center", va="center", fontsize=8)
    side = {"ha": "right"} if left else {"ha": "left"}
    offset = -0.12 if left else 0.12
    axes.text(x + offset, y + 0.42, name, weight="bold", fontsize=9, **side)
    axes.text(x + offset, y + 0.16, note, fontsize=7, color="0.35", **side)


def animate_replay(run: Path, file: Path) -> None:
    """Estimated and true position over time, from above, and the error with its sigma."""
    pose = pd.read_csv(run / "pose_vehicle_drone.tum", sep=r"\s+", comment="#", names=TUM)
    truth = pd.read_csv(run / "truth_vehicle_drone.tum", sep=r"\s+", comment="#", names=TUM)
    covariance = pd.read_csv(run / "pose_covariance.csv")
    t_s = pose.t - truth.t.iloc[0]
    xyz = np.column_stack([np.interp(pose.t, truth.t, truth[axis]) for axis in "xyz"])
    error_m = np.linalg.norm(pose[["x", "y", "z"]].to_numpy() - xyz, axis=1)
    sigma_m = _sigma_m(covariance)
    figure, (above, error) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained")
    above.plot(truth.y, truth.x, color="0.75", lw=1, label="truth")
    above.plot(0, 0, marker="s", color="0.3", ls="", label="vehicle")
    (trail,) = above.plot([], [], color="tab:blue", lw=2, label="grd")
    (drone,) = above.plot([], [], marker="o", color="tab:blue", ls="")
    above.set(xlabel="y left [m]", ylabel="x forward [m]", aspect="equal", title="Position in the vehicle frame")
    above.invert_xaxis()
    above.legend(loc="lower right", fontsize=7)
    if sigma_m is not None:
        error.fill_between(t_s, 0, 3 * sigma_m, color="tab:blue", alpha=0.15, label="3 sigma")
    (line,) = error.plot([], [], color="tab:red", label="3D error")
    error.set(
        xlim=(0, t_s.iloc[-1]),
        ylim=(0, 0.8),
        xlabel="t [s]",
        ylabel="[m]",
        title="Error against the simulation's truth",
    )
    error.legend(loc="upper right", fontsize=7)

    def draw(frame: int) -> list[object]:
        shown = int(frame / 39 * (len(pose) - 1)) + 1
        trail.set_data(pose.y[:shown], pose.x[:shown])
        drone.set_data(pose.y[shown - 1 : shown], pose.x[shown - 1 : shown])
        line.set_data(t_s[:shown], error_m[:shown])
        return [trail, drone, line]

    FuncAnimation(figure, draw, frames=40, blit=True).save(file, PillowWriter(fps=10), dpi=80)
    plt.close(figure)


def _sigma_m(covariance: pd.DataFrame) -> np.ndarray | None:
    """The worst axis' standard deviation of the position [m], from the variances in a covariance table."""
    names = [f"c{i}{i}" for i in (3, 4, 5)]
    if not set(names) <= set(covariance.columns):
        return None
    return np.sqrt(covariance[names].max(axis=1).to_numpy())


if __name__ == "__main__":
    main()
