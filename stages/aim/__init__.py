"""Aiming of the turntable (P III.A, III.C): the paper's method, pointing of single beams, and a plain sweep."""

from stages.aim.beam_aim import BeamAim as BeamAim
from stages.aim.calibration_sweep import CalibrationSweep as CalibrationSweep
from stages.aim.vibrate import SweepVibrateAim as SweepVibrateAim
