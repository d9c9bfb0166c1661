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

from flow.link import LinkError
from links.cli.console import check_output, err, out, report_errors
from links.cli.files import Overwrite
from links.cli.options import Jobs, Scheduler

if TYPE_CHECKING:
    from links.training.candidates import CandidateRows
    from stages.detect.trained.model import DetectorModel
    from stages.geometry.frames import Array64

LISTED_RUNS = 8
LIBRARIES = ("numpy", "scipy", "pandas")

Without = Annotated[
    list[str] | None, typer.Option("--without", help="Feature that the model does not use; repeatable.")
]


@report_errors
def train_detector(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs of simulated flights; split by recording.")],
    out_file: Annotated[
        Path, typer.Option("--out", "-o", help="Weights file to write, as configs/models/detector.yaml.")
    ],
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="Folder of runs that are scored and not trained on; repeatable."),
    ] = None,
    left_out: Without = None,
    start_file: Annotated[
        Path | None,
        typer.Option("--start", help="Weights file of an earlier training: the runs change it as far as they differ."),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Also train without each group of features, and score these models.")
    ] = False,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    overwrite: Overwrite = False,
) -> None:
    """Train the detector's model and score it on held-out runs.

    The scores are next to those of the probabilities that the runs logged. With OMP_NUM_THREADS=1 the same runs
    and library versions give the same file, which names the command, the seeds and the scores. Brier score and log loss
    are over classifications of candidates, by range, with and without telemetry.

    Example: grd train-detector out/train/* -o out/detector.yaml --held-out out/held_out
    """
    from links.training.candidates import lidar_model_of, read_candidates
    from links.training.fit import predicted, train
    from stages.detect.trained.features import FEATURES, GROUPS

    if ablation and not held_out:
        raise LinkError("--ablation needs --held-out: the models without a group are scored on these runs")
    check_output(out_file, "--out", overwrite=overwrite)
    start = None if start_file is None else _read_model(start_file)
    rows, lidar_model = read_candidates(runs, workers=scheduler or jobs), lidar_model_of(runs)
    folders = [run for folder in held_out or [] for run in sorted(folder.iterdir()) if run.is_dir()]
    trained: dict[str, Any] = {
        "command": _command(runs, out_file, held_out or [], left_out or [], start_file, ablation),
        "seeds": sorted({int(seed) for seed in rows.seed}),
        "runs": len(runs),
        "rows": len(rows.X),
        "drones": int(rows.is_drone.sum()),
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }
    model = train(rows, trained, left_out or [], lidar_model, start)
    _warn_of_end(trained["strength"])
    if folders:
        unseen = read_candidates(folders, workers=scheduler or jobs)
        trained["held_out"] = _compared(unseen, predicted(model, unseen))
        for group in ("nothing", *GROUPS) if ablation else ():
            names = [feature.name for feature in FEATURES if feature.group == group]
            less = train(rows, {}, [*(left_out or []), *names], lidar_model, start, [trained["strength"]])
            trained.setdefault("ablation", {})[group] = _ablated(group, unseen, predicted(less, unseen))
        model = model.model_copy(update={"trained": trained})
    _write_model(model, out_file)
    out.print(f"{out_file}: {len(rows.X)} rows of {len(runs)} runs", markup=False)


def _warn_of_end(strength: float) -> None:
    """Warn when the best penalty is the smallest or the largest that was tried."""
    from links.training.fit import STRENGTHS

    if strength in (STRENGTHS[0], STRENGTHS[-1]):
        err.print(
            f"warning: the best strength of the penalty, {strength:g}, is at an end of those tried "
            f"({STRENGTHS[0]:g} to {STRENGTHS[-1]:g}): another one may be better",
            markup=False,
        )


def _write_model(model: DetectorModel, file: Path) -> None:
    """Write a weights file: an overlay of the detector's settings."""
    import yaml

    text = yaml.safe_dump(
        {"stages": {"detect": {"config": {"model": model.model_dump(mode="json")}}}}, sort_keys=False, width=2000
    )
    file.write_text(f"# The detector's model, written by `grd train-detector`.\n{text}", encoding="utf-8")


def _read_model(file: Path) -> DetectorModel:
    """The model of a weights file. LinkError: it is none, or of other features."""
    from pydantic import ValidationError

    from flow.config.yaml_text import YamlTextError, yaml_values
    from stages.detect.trained.model import DetectorModel

    try:
        return DetectorModel.model_validate(yaml_values(file.read_bytes())["stages"]["detect"]["config"]["model"])
    except ValidationError as error:
        raise LinkError(f"{file}: {'; '.join(str(e['msg']) for e in error.errors())}") from None
    except (YamlTextError, KeyError, TypeError) as error:
        raise LinkError(f"{file}: not a weights file of `grd train-detector`: {error}") from None


def _command(
    runs: list[Path],
    out_file: Path,
    held_out: list[Path],
    left_out: list[str],
    start_file: Path | None,
    ablation: bool,
) -> str:
    """The command with all its options; many runs are counted, not listed."""
    options = ["-o", str(out_file)]
    for folder in held_out:
        options += ["--held-out", str(folder)]
    for name in left_out:
        options += ["--without", name]
    options += [] if start_file is None else ["--start", str(start_file)]
    options += ["--ablation"] if ablation else []
    listed = shlex.join(map(str, runs)) if len(runs) <= LISTED_RUNS else f"RUNS ({len(runs)})"
    return f"grd train-detector {listed} {shlex.join(options)}"


def _ablated(group: str, unseen: CandidateRows, probability: Array64) -> dict[str, list[float]]:
    """Brier score and log loss of a model without a group of features, with and without telemetry; printed."""
    from links.evaluation.errors import brier_and_log_loss

    found: dict[str, list[float]] = {}
    for name, here in (("with telemetry", unseen.with_telemetry), ("without telemetry", ~unseen.with_telemetry)):
        if here.any():
            brier, log_loss = brier_and_log_loss(probability[here], unseen.is_drone[here])
            found[name] = [round(brier, 5), round(log_loss, 4)]
            left_out = "all features" if group == "nothing" else f"without '{group}'"
            out.print(f"{left_out}, {name}: Brier {brier:.5f}, log loss {log_loss:.4f}", markup=False)
    return found


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
