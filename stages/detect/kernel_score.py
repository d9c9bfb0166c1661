"""The paper's two-box kernel on a depth image: a drone fills the inner box and has nothing at its depth in the outer.

    e = e_i + e_o, the lower the more like a drone, for each pixel c with depth d_c > 0:
    e_i = sum over the inner box of |d(p) - d_c|                                            Equation (2)
    s_ai = 2 floor(s h / Z_c / (2 res)) + 1 px, the drone's span s seen at depth Z_c         Equation (3)
    e_o = sum over the outer box without the inner of                                       Equations (4), (5)
          0 where d(p) = 0;  1 / eps where |d(p) - d_c| <= eps;  1 / |d(p) - d_c| elsewhere

Read here as printed: an empty pixel (d = 0) in the inner box counts d_c. The outer side of 20 px is made odd as the
inner is, 2 floor(20 / 2) + 1 = 21 px, so that both are centred on c. What lies outside the image counts as empty.
Where the inner box is the larger, e_o = 0.

Source: P III.B, Equations 1-5. Evaluated per box offset over a run of pixels, which the compiler turns into SIMD.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.kernels.detect.kernel_score import score_kernel

EMPTY_M = 1e18  # an empty pixel's depth in the outer box: 1 / 1e18 adds nothing, and its square still fits a float32


def inner_half_px(depth_m: float, focal_px: float, span_m: float) -> int:
    """Equation (3) as half a side: floor(s h / Z_c / (2 res)), h / res = focal_px. The inner side is twice this + 1."""
    return int(np.float32(span_m * focal_px) / np.float32(depth_m) * np.float32(0.5))


def score_image(
    depth_m: NDArray[np.float32], focal_px: float, span_m: float, outer_side_px: int, eps_m: float, nearest_m: float
) -> NDArray[np.float32]:
    """Equation (1), e per pixel (h, w); NaN for pixels that are empty or nearer than nearest_m."""
    half_outer = outer_side_px // 2
    pad = max(half_outer, inner_half_px(nearest_m, focal_px, span_m))
    padded = np.pad(depth_m, pad)
    far = np.where(padded > 0.0, padded, np.float32(EMPTY_M))
    score = np.full_like(depth_m, np.nan)
    score_kernel(
        depth_m, padded, far, pad, np.float32(span_m * focal_px), half_outer, np.float32(eps_m), nearest_m, score
    )
    return score
