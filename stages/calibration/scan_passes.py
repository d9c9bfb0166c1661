"""Inputs of a calibration: returns in the lidar frame, and the servo's position and rate at each of them.

Source: ours; angles are interpolated as in `stages/sweep/turntable.py`, so that the calibration matches its use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.calibration.servo_mount import ServoMount
from stages.geometry.frames import Array64
from stages.kernels.calibration.scan_passes import play_sides

SMOOTHED_STATES = (2, 4, 8, 12, 24)  # states on either side; wider windows suppress encoder steps better
RATE_STATES = 4  # states on either side for the rate; an encoder step is 0.088 deg


@dataclass(frozen=True)
class ServoTrace:
    """All servo states of a recording, in order; the position is unwrapped."""

    stamp_ns: NDArray[np.int64]  # (m,) as recorded
    position_rad: Array64  # (m,) smoothed over encoder steps

    @staticmethod
    def of(stamp_ns: NDArray[np.int64], position_rad: Array64, step_rad: float) -> ServoTrace:
        """From recorded states and the encoder's step; repeated and late states are omitted."""
        newest = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(stamp_ns)[:-1]])
        newer = stamp_ns > newest
        stamp_ns = stamp_ns[newer]
        return ServoTrace(stamp_ns, smoothed(stamp_ns, np.unwrap(position_rad[newer]), step_rad))


@dataclass(frozen=True)
class Returns:
    """Returns of the LiDAR, in order of time."""

    stamp_ns: NDArray[np.int64]  # (n,)
    laser: NDArray[np.uint8]  # (n,)
    xyz_lidar_m: Array64  # (n, 3)
    lasers: int = 16  # of the LiDAR


@dataclass(frozen=True)
class ServoAt:
    """The servo at the time of each return (n,)."""

    position_rad: Array64  # of the encoder; NaN where it or the side of the play is not known
    rate_radps: Array64
    play_side: Array64  # side of the play: +1 after upward, -1 after downward motion

    def taken(self, index: NDArray[np.int64]) -> ServoAt:
        """The values at `index`."""
        return ServoAt(self.position_rad[index], self.rate_radps[index], self.play_side[index])


def smoothed(stamp_ns: NDArray[np.int64], position_rad: Array64, step_rad: float) -> Array64:
    """Positions (m,) smoothed over encoder steps by a parabola through the neighbouring states.

    The window is the widest of SMOOTHED_STATES whose residuals match the step noise (step / sqrt(12), and the same for
    the stamps): wide during steady rotation, the position itself where the servo starts and stops.
    """
    found = position_rad.copy()
    if len(stamp_ns) < 2 * min(SMOOTHED_STATES) + 1:
        return found
    for half in sorted(SMOOTHED_STATES):
        first = np.clip(np.arange(len(stamp_ns)) - half, 0, max(len(stamp_ns) - 2 * half - 1, 0))
        window = np.minimum(first[:, None] + np.arange(2 * half + 1), len(stamp_ns) - 1)
        t = (stamp_ns[window] - stamp_ns[:, None]) * 1e-9
        span = np.abs(t).max(axis=1, keepdims=True)
        basis = np.stack([np.ones_like(t), t / span, (t / span) ** 2], axis=2)
        y = position_rad[window] - position_rad[:, None]
        gram: Array64 = np.einsum("mwi,mwj->mij", basis, basis)
        moment: Array64 = np.einsum("mwi,mw->mi", basis, y)
        fit = np.asarray(np.linalg.solve(gram, moment[..., None]), dtype=np.float64)[..., 0]
        off: Array64 = y - np.einsum("mwi,mi->mw", basis, fit)
        fits = (off**2).sum(axis=1) <= 2 * step_rad**2 / 12 * (2 * half - 2)
        fits &= np.abs(off).max(axis=1) < 1.5 * step_rad
        found = np.where(fits, position_rad + fit[:, 0], found)
    return found


def servo_at(trace: ServoTrace, stamp_ns: NDArray[np.int64], mount: ServoMount, max_gap_s: float) -> ServoAt:
    """The servo at pulses (n,), linear between its states, stamps shifted by the mount's offset."""
    state_ns = trace.stamp_ns + round(mount.time_offset_s * 1e9)
    after = np.searchsorted(state_ns, stamp_ns)
    inside = (after > 0) & (after < len(state_ns))
    after = np.clip(after, 1, len(state_ns) - 1)
    gap_ns = state_ns[after] - state_ns[after - 1]
    share = (stamp_ns - state_ns[after - 1]) / gap_ns
    before, step = trace.position_rad[after - 1], np.diff(trace.position_rad)[after - 1]
    play_side = np.empty(len(state_ns))
    play_sides(trace.position_rad, mount.play_rad, play_side)
    first, last = np.maximum(after - RATE_STATES, 0), np.minimum(after + RATE_STATES - 1, len(state_ns) - 1)
    rate = (trace.position_rad[last] - trace.position_rad[first]) / ((state_ns[last] - state_ns[first]) * 1e-9)
    known = inside & (gap_ns <= max_gap_s * 1e9) & (play_side[after - 1] == play_side[after])
    return ServoAt(
        position_rad=np.where(known, before + share * step, np.nan),
        rate_radps=rate,
        play_side=play_side[after],
    )
