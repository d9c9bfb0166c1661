"""An H.264 stream without an encoder: images that encode numbers, with uncompressed macroblocks (I_PCM).

An image is 64 x 48: twelve macroblocks, black or white, are the number's bits, the lowest first. Every tenth image is an
IDR; the others refer to it (P slices), as in a camera's stream.

Source: ITU-T H.264, 7.3.2.1.1 (sequence parameter set), 7.3.2.2 (picture parameter set), 7.3.3 (slice header),
7.3.5 (macroblock), 7.4.1.1 (emulation prevention), 9.1 (Exp-Golomb codes).
"""

from __future__ import annotations

import re

import numpy as np

COLUMNS, ROWS = 4, 3  # macroblocks of 16 x 16
GROUP = 10  # images from one IDR to the next
BLACK, WHITE = 16, 235
P_SLICE, I_SLICE = 5, 7  # slice types: all slices of the image have that type


class Bits:
    """A bit writer; each method returns self."""

    def __init__(self):
        self.text = ""

    def u(self, count, value):
        self.text += f"{value:0{count}b}"
        return self

    def ue(self, *values):
        for value in values:
            self.text += "0" * ((value + 1).bit_length() - 1) + f"{value + 1:b}"
        return self

    def align(self):
        self.text += "0" * (-len(self.text) % 8)
        return self

    def unit(self, header):
        """The NAL unit: header byte, these bits with the stop bit, and emulation prevention."""
        body = self.u(1, 1).align().text
        data = int(body, 2).to_bytes(len(body) // 8)
        return bytes([header]) + re.sub(rb"\0\0(?=[\0-\3])", b"\0\0\3", data)


def sequence():
    """Baseline, level 1.1, 4 bits of frame number, order of output as coded (type 2), one reference frame."""
    bits = Bits().u(8, 66).u(8, 0b1100_0000).u(8, 11).ue(0, 0, 2, 1).u(1, 0)
    return bits.ue(COLUMNS - 1, ROWS - 1).u(1, 1).u(1, 1).u(1, 0).u(1, 0).unit(0x67)


def picture_parameters():
    """CAVLC, one slice group, no weights, quantiser 26."""
    return Bits().ue(0, 0).u(2, 0).ue(0, 0, 0).u(3, 0).ue(0, 0, 0).u(3, 0).unit(0x68)


def image(number):
    """The NAL units of one image; the parameter sets precede an IDR."""
    frame = number % GROUP
    is_idr = frame == 0
    bits = Bits().ue(0, I_SLICE if is_idr else P_SLICE, 0).u(4, frame)
    if is_idr:
        bits.ue(number // GROUP % 2).u(2, 0)  # consecutive IDRs differ; no earlier references
    else:
        bits.u(2, 0).u(1, 0)  # default references; sliding window
    bits.ue(0)
    for at in range(COLUMNS * ROWS):
        luma = WHITE if number >> at & 1 else BLACK
        if not is_idr:
            bits.ue(0)  # no macroblock is skipped
        bits.ue(25 if is_idr else 30).align()  # I_PCM
        bits.text += f"{luma:08b}" * 256 + f"{128:08b}" * 128
    slice_unit = bits.unit(0x65 if is_idr else 0x61)
    return [sequence(), picture_parameters(), slice_unit] if is_idr else [slice_unit]


def number_of(grey):
    """The number that an image of 48 rows and 64 columns encodes."""
    white = np.asarray(grey).reshape(ROWS, 16, COLUMNS, 16).mean(axis=(1, 3)).ravel() > 128
    return int(sum(1 << at for at in range(COLUMNS * ROWS) if white[at]))
