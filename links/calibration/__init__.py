"""Self-calibration of a recording: its inputs, the new rig file, figures (links/calibration/figures.py, by matplotlib).

Source: grd; the maths is in `stages/calibration`.
"""

from links.calibration.gather import Gathered as Gathered
from links.calibration.gather import gather as gather
from links.calibration.rig_file import rig_text as rig_text
from links.calibration.rig_file import zero_found as zero_found
