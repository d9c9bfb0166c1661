"""P III.B: which of the returns may be a drone. By the paper's kernel, or by accumulated evidence (grd)."""

from stages.detect.evidence_detect import EvidenceDetect as EvidenceDetect
from stages.detect.paper.kernel_detect import KernelDetect as KernelDetect
