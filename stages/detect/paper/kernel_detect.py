"""Detector of the paper: drone candidates in the depth image of a sweep, each with a score and a reason.

    t_hat_0 = unproject(argmin_c e(c))                                                      Equation (1)

over all pixels with depth, e from `stages/detect/paper/kernel_candidates.py`. The paper always reports a drone at that
pixel. Here the local minima are tested in ascending order of score, and each is accepted or rejected with a reason.
`gates: null` is the paper's method: the pixel of lowest score is accepted.

Source: P III.B, Equations 1-5; the gates are ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.detect.paper.kernel_candidates import Gates, Pixel, inner_half_px, local_minima, reject_reason, score_image
from stages.kernels.detect.kernel_score import kernel_terms
from stages.messages import DepthImage, Detections, KernelScores, ScoreImage
from stages.sweep.depth_image import unproject


class Candidate(NamedTuple):
    """One local minimum and whether it is accepted."""

    pixel: Pixel
    accepted: bool
    reason: str


class KernelDetectSettings(Settings):
    """Settings of `KernelDetect`.

    `nearest_m`: least depth of a candidate, farther than the vehicle's own roof; it also bounds the inner box.
    """

    span_m: float = Field(0.5, gt=0, le=10)  # s, largest dimension of the drone
    outer_side_px: int = Field(20, ge=2, le=200)  # s_ao, side of the outer box
    eps_m: float = Field(0.1, ge=1e-3)  # eps of Equations 4 and 5
    nearest_m: float = Field(1.0, ge=0.1)
    gates: Gates | None = Gates()  # null: the paper's method
    max_minima: int = Field(128, ge=1)  # local minima that are tested
    max_candidates: int = Field(12, ge=1)  # per published message

    @model_validator(mode="after")
    def _settings_agree(self) -> KernelDetectSettings:
        if self.gates is not None and self.gates.neighbour_m <= self.span_m:
            raise ValueError("gates.neighbour_m must be larger than span_m: no object may be within it next to a drone")
        return self


class KernelDetect(Stage[KernelDetectSettings]):
    """P III.B: the two-box kernel. Accepted detections come from at most `max_minima` minima, best score first."""

    def on_image(self, image: DepthImage) -> Iterator[ScoreImage | Detections]:
        """Score every pixel, then accept or reject the minima."""
        settings = self.settings
        score = score_image(
            image.depth_m, image.focal_px, settings.span_m, settings.outer_side_px, settings.eps_m, settings.nearest_m
        )
        yield ScoreImage(stamp_ns=image.stamp_ns, score=score)
        half_outer = settings.outer_side_px // 2
        minima = local_minima(score, image.depth_m, half_outer, settings.span_m, settings.max_minima)
        candidates = [self._candidate(image, pixel, rank) for rank, pixel in enumerate(minima)]
        yield self._detections(image, candidates)

    def _candidate(self, image: DepthImage, pixel: Pixel, rank: int) -> Candidate:
        settings = self.settings
        if settings.gates is None:
            return Candidate(pixel, rank == 0, "lowest score" if rank == 0 else "not the lowest score")
        reason = reject_reason(image, pixel, settings.span_m, settings.outer_side_px, settings.gates)
        return Candidate(pixel, reason is None, reason or "small, isolated, and measured completely")

    def _detections(self, image: DepthImage, candidates: list[Candidate]) -> Detections:
        # accepted candidates have precedence; the message lists them in the order of their scores
        ranks = sorted(range(len(candidates)), key=lambda rank: (not candidates[rank].accepted, rank))[
            : self.settings.max_candidates
        ]
        listed = [candidates[rank] for rank in sorted(ranks)]
        xyz_vehicle_m = np.array([unproject(image, *c.pixel) for c in listed], dtype=np.float64).reshape(-1, 3)
        terms = np.array([self._terms(image, c.pixel) for c in listed], dtype=np.float64).reshape(-1, 2)
        accepted = np.array([c.accepted for c in listed], dtype=np.bool_)
        if accepted.any():
            best = int(accepted.argmax())
            x, y, z = xyz_vehicle_m[best]
            summary = f"drone at ({x:.2f}, {y:.2f}, {z:.2f}) m, score {terms[best].sum():.3g}"
            if accepted.sum() > 1:
                summary += f"; {int(accepted.sum()) - 1} more with a higher score"
        else:
            summary = f"no drone: {self._no_drone_reason(image, candidates)}"
        return Detections(
            stamp_ns=image.stamp_ns,
            xyz_vehicle_m=xyz_vehicle_m,
            accepted=accepted,
            reasons=tuple(c.reason for c in listed),
            summary=summary,
            evidence=KernelScores(e_inner=terms[:, 0].copy(), e_outer=terms[:, 1].copy()),
        )

    def _terms(self, image: DepthImage, pixel: Pixel) -> tuple[float, float]:
        settings = self.settings
        half_inner = inner_half_px(float(image.depth_m[pixel]), image.focal_px, settings.span_m)
        return kernel_terms(image.depth_m, *pixel, half_inner, settings.outer_side_px // 2, settings.eps_m)

    def _no_drone_reason(self, image: DepthImage, candidates: list[Candidate]) -> str:
        if not candidates:
            view_deg = math.degrees(math.atan(image.depth_m.shape[1] / 2 / image.focal_px))
            near = f", none of them {self.settings.nearest_m:g} m or more above the turntable" if image.points else ""
            return f"{image.points} of {image.returns} returns lie within {view_deg:.0f} deg of straight up{near}"
        limit = f" (the {len(candidates)} lowest scores)" if len(candidates) == self.settings.max_minima else ""
        return f"all {len(candidates)} candidates rejected{limit}; the best: {candidates[0].reason}"
