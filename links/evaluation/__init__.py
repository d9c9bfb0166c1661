"""Judges runs against truth: `grd evaluate`.

Source: DESIGN, Command line.
"""

from links.evaluation.errors import Limits
from links.evaluation.evaluate import evaluate
from links.evaluation.judged import Evaluation
from links.evaluation.run_data import RunData, read_run

__all__ = ["Evaluation", "Limits", "RunData", "evaluate", "read_run"]
