"""Rotation of the drone relative to the vehicle from both cameras: the method of the paper, and the joint alignment."""

from stages.align.joint_align import JointAlign as JointAlign
from stages.align.paper_align import PaperAlign as PaperAlign
