"""P IV, V.C-V.E: how the drone is turned in the vehicle's axes. The paper's matching, and ours, of both cameras."""

from stages.align.joint_align import JointAlign as JointAlign
from stages.align.paper_align import PaperAlign as PaperAlign
