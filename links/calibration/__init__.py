"""Self-calibration as a job over a recording: what goes in, the new rig file, the pictures.

Source: ours; the maths is in `stages/calibration`.
"""

from links.calibration.gather import Gathered as Gathered
from links.calibration.gather import gather as gather
from links.calibration.pictures import pictures as pictures
from links.calibration.rig_file import rig_text as rig_text
from links.calibration.rig_file import zero_told as zero_told
