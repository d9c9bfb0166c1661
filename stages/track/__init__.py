"""P III.C: where the drone is, look by look. The paper's mean shift, and ours by hits and misses."""

from stages.track.likelihood_track import LikelihoodTrack as LikelihoodTrack
from stages.track.mean_shift_track import MeanShiftTrack as MeanShiftTrack
