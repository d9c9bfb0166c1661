"""Detect: the depth image of a sweep becomes drone candidates with a score and a reason each.

    t_hat_0 = unproject(argmin_c e(c))                                                      Equation (1)

over all pixels with depth, e from `stages/detect/kernel_candidates.py`. The paper stops there, so it always reports a
drone. Here the local minima are taken in ascending order of score, and each is accepted or refused with a reason.
`gates: null` is the paper literally: the lowest score is the drone.

Source: P III.B, Equations 1-5; the gates are ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.detect.kernel_candidates import Gates, Pixel, inner_half_px, local_minima, refusal, score_image
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

    `nearest_m`: nothing nearer is a candidate (the vehicle's own roof); it also bounds the inner box.
    """

    span_m: float = Field(0.5, gt=0, le=10)  # s, the drone's largest extent
    outer_side_px: int = Field(20, ge=2, le=200)  # s_ao
    eps_m: float = Field(0.1, ge=1e-3)  # eps
    nearest_m: float = Field(1.0, ge=0.1)
    gates: Gates | None = Gates()
    max_minima: int = Field(128, ge=1)  # looked at
    max_candidates: int = Field(12, ge=1)  # given out

    @model_validator(mode="after")
    def _settings_agree(self) -> KernelDetectSettings:
        if self.gates is not None and self.gates.company_m <= self.span_m:
            raise ValueError("gates.company_m must be larger than span_m: it is where a drone has nothing beside it")
        return self


class KernelDetect(Stage[KernelDetectSettings]):
    """P III.B: the two-box kernel. Accepted detections come from at most `max_minima` minima, best score first."""

    def on_image(self, image: DepthImage) -> Iterator[ScoreImage | Detections]:
        """Score every pixel, then judge the minima."""
        settings = self.settings
        score = score_image(
            image.depth_m, image.focal_px, settings.span_m, settings.outer_side_px, settings.eps_m, settings.nearest_m
        )
        yield ScoreImage(stamp_ns=image.stamp_ns, score=score)
        half_outer = settings.outer_side_px // 2
        minima = local_minima(score, image.depth_m, half_outer, settings.span_m, settings.max_minima)
        judged = [self._judge(image, pixel, rank) for rank, pixel in enumerate(minima)]
        yield self._detections(image, judged)

    def _judge(self, image: DepthImage, pixel: Pixel, rank: int) -> Candidate:
        settings = self.settings
        if settings.gates is None:
            return Candidate(pixel, rank == 0, "lowest score" if rank == 0 else "not the lowest score")
        why = refusal(image, pixel, settings.span_m, settings.outer_side_px, settings.gates)
        return Candidate(pixel, why is None, why or "small, alone, and seen whole")

    def _detections(self, image: DepthImage, judged: list[Candidate]) -> Detections:
        # accepted ones first in line for a place, then the list in the order of their scores again
        places = sorted(range(len(judged)), key=lambda rank: (not judged[rank].accepted, rank))[
            : self.settings.max_candidates
        ]
        listed = [judged[rank] for rank in sorted(places)]
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
            summary = f"no drone: {self._why_none(image, judged)}"
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

    def _why_none(self, image: DepthImage, judged: list[Candidate]) -> str:
        if not judged:
            view_deg = math.degrees(math.atan(image.depth_m.shape[1] / 2 / image.focal_px))
            near = f", none of them {self.settings.nearest_m:g} m or more above the turntable" if image.points else ""
            return f"{image.points} of {image.returns} returns lie within {view_deg:.0f} deg of straight up{near}"
        limit = f" (the {len(judged)} lowest scores)" if len(judged) == self.settings.max_minima else ""
        return f"all {len(judged)} candidates refused{limit}; the best: {judged[0].reason}"
