"""The detector with the model of configs/models/detector.yaml."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import yaml

from stages.detect import EvidenceDetect
from stages.detect.trained.model import DetectorModel

MODEL = Path(__file__).parents[3] / "configs/models/detector.yaml"


@cache
def shipped_model() -> DetectorModel:
    """The shipped weights."""
    return DetectorModel.model_validate(yaml.safe_load(MODEL.read_text())["stages"]["detect"]["config"]["model"])


def detector(**settings: Any) -> EvidenceDetect:
    """EvidenceDetect with the shipped weights, unless `settings` have others."""
    return EvidenceDetect(**{"model": shipped_model(), **settings})
