"""What a beam keeps meeting for longer than the drone is wide is a wall, and none of its returns is the drone's.

The pulses of one laser follow each other 0.2 deg apart. Returns in a row at much the same range are one run; a drone's
are short, also where it hangs before a wall, because the range steps at its edge. A run with something nearer at both
ends is a glimpse through a gap, between leaves say: nobody knows how far it goes on behind.

Source: ours, for P III.C; runs end as the detector's chords do (`stages/detect/chords.py`).
"""

from __future__ import annotations
