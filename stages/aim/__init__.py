"""P III.A and III.C: where the turntable goes. The paper's sweep and vibration, and ours that puts a beam on it."""

from stages.aim.beam_aim import BeamAim as BeamAim
from stages.aim.vibrate import SweepVibrateAim as SweepVibrateAim
