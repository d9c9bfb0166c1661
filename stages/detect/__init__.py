"""P III.B: which of the returns may be a drone. The paper's kernel, and ours by evidence."""

from stages.detect.evidence import EvidenceDetect as EvidenceDetect
from stages.detect.kernel import KernelDetect as KernelDetect
