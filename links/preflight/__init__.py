"""Preflight: is all that a configuration declares there, healthy, and of one mind about the axes? Go or no go.

Source: ours; issue 6, point 3.
"""

from links.preflight.by_hand import Step
from links.preflight.preflight import OUT_DIR, preflight_live, preflight_recording
from links.preflight.verdict import Level, Verdict, is_go

__all__ = ["OUT_DIR", "Level", "Step", "Verdict", "is_go", "preflight_live", "preflight_recording"]
