"""Vanishing directions of the straight lines in an image (P IV, V.C): the paper's method on rectified views, and grd's
by great circles on the native fisheye."""

from stages.vp.great_circle_vp import GreatCircleVp as GreatCircleVp
from stages.vp.paper_vp import PaperVp as PaperVp
