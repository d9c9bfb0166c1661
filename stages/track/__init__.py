"""P III.C: position of the tracked drone, by mean shift (paper) or by returns and pass-throughs (grd)."""

from stages.track.likelihood_track import LikelihoodTrack as LikelihoodTrack
from stages.track.mean_shift_track import MeanShiftTrack as MeanShiftTrack
