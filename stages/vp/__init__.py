"""P IV, V.C: in which directions a picture's straight lines run. The paper's rectified views, and ours by
great circles on the native fisheye."""

from stages.vp.great_circle_vp import GreatCircleVp as GreatCircleVp
from stages.vp.paper_vp import PaperVp as PaperVp
