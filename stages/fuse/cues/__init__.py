"""Cues in the fusion: GNSS, ranges and altitude as factors with a bias of their own."""

from stages.fuse.cues.cue_fusion import CueFusion as CueFusion
