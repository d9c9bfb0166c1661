"""`grd train-detector`: the detector's model from the candidate logs of runs.

Source: ours.
"""

from __future__ import annotations

import importlib.metadata
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from links.cli.console import err, out, report_errors

if TYPE_CHECKING:
    from links.training.candidates import CandidateRows
    from stages.geometry.frames import Array64

LISTED_RUNS = 8
LIBRARIES = ("numpy", "scipy", "pandas")


@report_errors
def train_detector(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs of simulated flights; split by their seeds.")],
    out_file: Annotated[
        Path, typer.Option("--out", "-o", help="Weights file to write, as configs/models/detector.yaml.")
    ],
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="Folder of runs that are scored and not trained on; repeatable."),
    ] = None,
    left_out: Annotated[
        list[str] | None, typer.Option("--without", help="Feature that the model does not use (ablation); repeatable.")
    ] = None,
) -> None:
    """Train the detector's model and score it on held-out runs.

    The scores are next to those of the probabilities that the runs logged. With OMP_NUM_THREADS=1 the same runs
    and library versions give the same file, which names the command, the seeds and the scores. Brier score and log loss
    are over classifications of candidates, by range, with and without telemetry.

    Example: grd train-detector out/train/* -o configs/models/detector.yaml --held-out out/held_out
    """
    import yaml

    from links.training.candidates import lidar_model_of, read_candidates
    from links.training.fit import STRENGTHS, predicted, train

    rows, lidar_model = read_candidates(runs), lidar_model_of(runs)
    folders = [run for folder in held_out or [] for run in sorted(folder.iterdir()) if run.is_dir()]
    trained: dict[str, Any] = {
        "command": _command(runs, out_file, held_out or [], left_out or []),
        "seeds": sorted({int(seed) for seed in rows.seed}),
        "runs": len(runs),
        "rows": len(rows.X),
        "drones": int(rows.is_drone.sum()),
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }
    model = train(rows, trained, left_out or [], lidar_model)
    if trained["strength"] in (STRENGTHS[0], STRENGTHS[-1]):
        err.print(
            f"warning: the best strength of the penalty, {trained['strength']:g}, is at an end of those tried "
            f"({STRENGTHS[0]:g} to {STRENGTHS[-1]:g}): another one may be better",
            markup=False,
        )
    if folders:
        unseen = read_candidates(folders)
        trained["held_out"] = _compared(unseen, predicted(model, unseen))
        model = model.model_copy(update={"trained": trained})
    text = yaml.safe_dump(
        {"stages": {"detect": {"config": {"model": model.model_dump(mode="json")}}}}, sort_keys=False, width=2000
    )
    out_file.write_text(f"# The detector's model, written by `grd train-detector`.\n{text}", encoding="utf-8")
    out.print(f"{out_file}: {len(rows.X)} rows of {len(runs)} runs", markup=False)


def _command(runs: list[Path], out_file: Path, held_out: list[Path], left_out: list[str]) -> str:
    """The command with all its options; many runs are counted, not listed."""
    options = ["-o", str(out_file)]
    for folder in held_out:
        options += ["--held-out", str(folder)]
    for name in left_out:
        options += ["--without", name]
    listed = shlex.join(map(str, runs)) if len(runs) <= LISTED_RUNS else f"RUNS ({len(runs)})"
    return f"grd train-detector {listed} {shlex.join(options)}"


def _compared(unseen: CandidateRows, probability: Array64) -> list[dict[str, Any]]:
    """Scores of the model on unseen rows, next to those of the logged probabilities; printed."""
    from links.training.fit import scores

    found: list[dict[str, Any]] = []
    for new, logged in zip(scores(unseen, probability), scores(unseen, unseen.logged), strict=True):
        row = {name: round(value, 4) if isinstance(value, float) else value for name, value in asdict(new).items()}
        found.append(row | {"logged_brier": round(logged.brier, 4), "logged_log_loss": round(logged.log_loss, 4)})
        out.print(
            f"{new.band}: {new.rows} rows, {new.drones} drones, Brier {new.brier:.4f} (logged {logged.brier:.4f}), "
            f"log loss {new.log_loss:.4f} (logged {logged.log_loss:.4f})",
            markup=False,
        )
    return found
