"""P III.B: which of the returns may be a drone. The paper's kernel, and ours by evidence."""

from stages.detect.evidence_detect import EvidenceDetect as EvidenceDetect
from stages.detect.kernel_detect import KernelDetect as KernelDetect
