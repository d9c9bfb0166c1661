"""P III.A: packets and servo angles to points in the vehicle frame."""

from stages.sweep.sweep import Sweep as Sweep
