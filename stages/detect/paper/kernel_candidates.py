"""Local minima of the score image, and the gates that accept or reject each of them.

Source: ours. The paper accepts argmin e for any value, so that it always reports a drone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from stages.kernels.detect.kernel_candidates import lowest_indices, middle_m, minima, neighbour_pixels, own_pixels
from stages.kernels.detect.kernel_score import score_kernel
from stages.messages import DepthImage
from stages.sweep.depth_image import unproject

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


FIRST_SORTED = 16_384  # pixels searched first for minima; sorting all of a full image takes as long as scoring it


class Gates(StrictModel):
    """Conditions that a candidate must satisfy to be accepted. None (or false) turns a gate off.

    Chosen by reasoning, not fitted to any recording:
    - `min_inner_px` 3: with an inner box of one pixel e_i = 0 for any object, so that the kernel cannot discriminate.
      With the paper's settings that is beyond 37 m.
    - `whole_box`: near the image's border the outer box is incomplete, so that its empty pixels are no evidence.
    - `min_pixels` 3: rain, dust, an insect or a wrong return fill a pixel or two. One beam crossing a 0.5 m drone gives
      four returns even at 37 m (0.2 deg between pulses), and most sweeps cross it more than once.
    - `max_neighbour_ratio` 0.25: a drone is isolated. This is the allowed number of pixels between the span and
      `neighbour_m` from it, per pixel within the span (false returns; motion between two passes of the fan, up to
      2 m/s). Larger objects have more: a 2 m long chord of one beam over a gable 1, a long line or its end 3, an edge
      or a surface 15.
    - `min_width_px` 1.5: the chord of one beam is a line, less than 1.5 px wide. Beams are 2 deg apart, so that the
      surroundings of a single chord are not measured: it may be the top of a post or the edge of a sign. A sweep
      crosses a drone about five times at 12 m, twice at 30 m.
    """

    min_inner_px: int | None = Field(default=3, ge=1)
    whole_box: bool = True
    min_pixels: int | None = Field(default=3, ge=1)
    max_neighbour_ratio: float | None = Field(default=0.25, ge=0)
    neighbour_m: float = Field(default=2.0, gt=0)
    min_width_px: float | None = Field(default=1.5, ge=0)


class Pixel(NamedTuple):
    """Indices of a pixel of the depth image."""

    row: int
    column: int


def local_minima(
    score: NDArray[np.float32], depth_m: NDArray[np.float32], radius_px: int, same_m: float, at_most: int
) -> list[Pixel]:
    """The pixels of lowest score, best first, one per object.

    A minimum suppresses the pixels up to radius_px away whose depth is within same_m of its own: they are the same
    object. Equal scores are ordered by row, then column.
    """
    flat = np.ascontiguousarray(score).ravel()
    few = FIRST_SORTED
    while True:
        index = lowest_indices(flat.view(np.uint32), few)
        # The bits of non-negative floats sort as the floats do. With the index below them one integer sort does both.
        key = np.sort((flat[index].view(np.uint32).astype(np.uint64) << 32) | index.astype(np.uint64))
        found = minima((key & 0xFFFFFFFF).astype(np.int64), depth_m, radius_px, same_m, at_most)
        if len(found) == at_most or index.size < few:
            return [Pixel(int(row), int(column)) for row, column in found]
        few *= 4


def width_px(pixels: NDArray[np.int64]) -> float:
    """Extent [px] of pixels (n, 2) across the direction in which they spread most."""
    offsets = pixels - pixels.mean(axis=0)
    across = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]  # eigenvector of the smaller eigenvalue
    return float(np.ptp(offsets @ across))


def reject_reason(image: DepthImage, pixel: Pixel, span_m: float, outer_side_px: int, gates: Gates) -> str | None:
    """Reason for which a candidate is rejected; None when it passes every gate."""
    depth_c = float(image.depth_m[pixel])
    inner_px = 2 * inner_half_px(depth_c, image.focal_px, span_m) + 1
    if gates.min_inner_px is not None and inner_px < gates.min_inner_px:
        limit_m = span_m * image.focal_px / (gates.min_inner_px - 1)
        return f"the inner box is {inner_px} px at {depth_c:.0f} m: beyond {limit_m:.0f} m it cannot detect a drone"
    height, width = image.depth_m.shape
    border_px = min(pixel.row, pixel.column, height - 1 - pixel.row, width - 1 - pixel.column)
    if gates.whole_box and border_px < outer_side_px // 2:
        return f"{border_px} px from the image's border: its surroundings were not measured"
    at_pixel_m = unproject(image, *pixel) - image.origin_vehicle_m
    first = own_pixels(image.depth_m, image.focal_px, at_pixel_m, span_m)
    # the pixel may be at the edge of the object: its middle is the mean of the pixels near it
    centre_m = middle_m(image.depth_m, image.focal_px, first)
    pixels = own_pixels(image.depth_m, image.focal_px, centre_m, span_m)
    own = len(pixels)
    if gates.min_pixels is not None and own < gates.min_pixels:
        return f"{own} px filled within {span_m:g} m, at least {gates.min_pixels} needed: may be rain or dust"
    if gates.max_neighbour_ratio is not None:
        most = math.floor(gates.max_neighbour_ratio * own)
        if neighbour_pixels(image.depth_m, image.focal_px, centre_m, span_m, gates.neighbour_m, most + 1) > most:
            counts = f"{own} px within {span_m:g} m, but more than {most} others within {gates.neighbour_m:g} m"
            return f"part of a larger object: {counts}"
    if gates.min_width_px is not None and width_px(pixels) < gates.min_width_px:
        return f"{own} px in one line: a single chord of a beam, its surroundings were not measured"
    return None
