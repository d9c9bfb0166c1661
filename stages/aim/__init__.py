"""P III.A and III.C: where the turntable goes. The paper's, ours that puts a beam on the drone, and a plain sweep."""

from stages.aim.beam_aim import BeamAim as BeamAim
from stages.aim.calibration_sweep import CalibrationSweep as CalibrationSweep
from stages.aim.vibrate import SweepVibrateAim as SweepVibrateAim
