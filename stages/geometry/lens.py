"""Fisheye lenses on unit vectors: equidistant, Kannala-Brandt and OCam, beyond 90 deg off axis.

Frame: camera (x right in the image, y down, z along the optical axis). Pixels are (column, row), whole numbers are
pixel centres. A ray at angle theta off the axis and azimuth phi meets the sensor at centre + A rho (cos phi, sin phi).

| model          | rho(theta)                                                        | A                           |
| -------------- | ----------------------------------------------------------------- | --------------------------- |
| equidistant    | theta                                                             | f I                         |
| kannala_brandt | theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9         | diag(fx, fy)                |
| ocam           | root of rho cos(theta) + f(rho) sin(theta) = 0, f(rho) = sum a_i rho^i (a_0 < 0) | [[1, e], [d, c]] |

Rays are the truth: `project` inverts OCam's direct polynomial exactly instead of using its fitted inverse.

Source: Kannala and Brandt, A generic camera model, PAMI 2006, eq. 6 (as in Kalibr's pinhole-equi);
Scaramuzza, OCamCalib, world2cam/cam2world (there x is down, y right and z backwards). Ours beyond 90 deg: cv2.fisheye
mirrors and collapses there.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from flow.stage import StrictModel
from stages.geometry.frames import Array64
from stages.kernels.geometry.lens import ANGLE_SERIES, OCAM, polynomial_kernel, project, rho_of_theta, series, unproject

Pixel = tuple[float, float]
Polygon = Annotated[tuple[Pixel, ...], Field(min_length=3)]  # corners (column, row)
FocalPx = Annotated[float, Field(gt=0)]

WIDEST_RHO = 20.0  # focal lengths; no image circle is wider


class _Lens(StrictModel):
    """What all lenses share. A ray or pixel beyond `max_off_axis_deg` gives NaN, never a wrong number."""

    centre_px: Pixel  # (column, row) of the optical axis
    max_off_axis_deg: float = Field(default=117.5, gt=0, le=150)
    _max_rho: float = PrivateAttr(default=0.0)

    def _radial(self) -> tuple[int, Array64]:
        raise NotImplementedError

    def _affine(self) -> Array64:
        raise NotImplementedError

    @model_validator(mode="after")
    def _grows_to_its_edge(self) -> Self:
        if abs(np.linalg.det(self._affine())) < 1e-9:
            raise ValueError("the focal lengths or affine terms leave no image: their matrix is singular")
        largest, reached = _monotonic_to(*self._radial(), math.radians(self.max_off_axis_deg))
        if math.degrees(reached) < self.max_off_axis_deg - 1e-6:
            raise ValueError(
                f"these coefficients fold the image back at {math.degrees(reached):.1f} deg off axis: "
                f"set max_off_axis_deg to at most {math.floor(10 * math.degrees(reached)) / 10:.1f}"
            )
        self._max_rho = largest
        return self

    def project(self, rays: Array64) -> Array64:
        """Pixels (n, 2) of rays (n, 3) in the camera frame, of any length; NaN beyond the lens's edge."""
        kind, coefficients = self._radial()
        limit = math.radians(self.max_off_axis_deg)
        return project(
            _rows(rays, 3), kind, coefficients, self._affine(), np.array(self.centre_px), limit, self._max_rho
        )

    def unproject(self, pixels: Array64) -> Array64:
        """Unit rays (n, 3) in the camera frame of pixels (n, 2); NaN outside the lens's circle."""
        kind, coefficients = self._radial()
        limit = math.radians(self.max_off_axis_deg)
        inverse = np.asarray(np.linalg.inv(self._affine()), dtype=np.float64)
        return unproject(_rows(pixels, 2), kind, coefficients, inverse, np.array(self.centre_px), limit, self._max_rho)

    @property
    def circle_px(self) -> float:
        """Radius of the image circle, where rays are `max_off_axis_deg` off the axis."""
        return self._max_rho * math.sqrt(abs(float(np.linalg.det(self._affine()))))

    def _scaled_centre(self, factor: float) -> Pixel:
        return (self.centre_px[0] + 0.5) * factor - 0.5, (self.centre_px[1] + 0.5) * factor - 0.5


class Equidistant(_Lens):
    """r = f theta: the ideal fisheye."""

    model: Literal["equidistant"] = "equidistant"
    focal_px: FocalPx

    def _radial(self) -> tuple[int, Array64]:
        return ANGLE_SERIES, np.array([1.0, 0.0, 0.0, 0.0, 0.0])

    def _affine(self) -> Array64:
        return self.focal_px * np.eye(2)

    def scaled(self, factor: float) -> Equidistant:
        """The same lens on an image enlarged by `factor`."""
        return self.model_validate(
            self.model_dump() | {"focal_px": self.focal_px * factor, "centre_px": self._scaled_centre(factor)}
        )


class KannalaBrandt(_Lens):
    """r = f (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9)."""

    model: Literal["kannala_brandt"] = "kannala_brandt"
    focal_px: tuple[FocalPx, FocalPx]  # fx, fy
    k: tuple[float, float, float, float]

    def _radial(self) -> tuple[int, Array64]:
        return ANGLE_SERIES, np.array([1.0, *self.k])

    def _affine(self) -> Array64:
        return np.diag(self.focal_px)

    def scaled(self, factor: float) -> KannalaBrandt:
        """The same lens on an image enlarged by `factor`."""
        focal = (self.focal_px[0] * factor, self.focal_px[1] * factor)
        return self.model_validate(self.model_dump() | {"focal_px": focal, "centre_px": self._scaled_centre(factor)})


class OCam(_Lens):
    """Scaramuzza's polynomial: the ray of a point (x, y), rho from the centre, is (x, y, -sum a_i rho^i)."""

    model: Literal["ocam"] = "ocam"
    polynomial: tuple[float, ...] = Field(min_length=2, max_length=10)  # a_0 (negative), a_1, ... for rho in pixels
    affine_cde: tuple[float, float, float] = (1.0, 0.0, 0.0)  # row = c x + d y, column = e x + y, x down, y right

    @field_validator("polynomial")
    @classmethod
    def _looks_forward(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if value[0] >= 0:
            raise ValueError("the first coefficient must be negative, as OCamCalib writes it")
        return value

    def _radial(self) -> tuple[int, Array64]:
        return OCAM, np.array(self.polynomial)

    def _affine(self) -> Array64:
        c, d, e = self.affine_cde
        return np.array([[1.0, e], [d, c]])

    def scaled(self, factor: float) -> OCam:
        """The same lens on an image enlarged by `factor`: a_i becomes a_i factor^(1 - i)."""
        polynomial = tuple(a * factor ** (1 - i) for i, a in enumerate(self.polynomial))
        return self.model_validate(
            self.model_dump() | {"polynomial": polynomial, "centre_px": self._scaled_centre(factor)}
        )


Lens = Annotated[Equidistant | KannalaBrandt | OCam, Field(discriminator="model")]


def _rows(values: Array64, width: int) -> Array64:
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"expected an array of shape (n, {width}), got {rows.shape}")
    return rows


def _monotonic_to(kind: int, a: Array64, max_theta: float) -> tuple[float, float]:
    """(rho, theta) of the widest ray up to max_theta to which radius and angle grow together."""
    if kind == ANGLE_SERIES:
        theta = np.linspace(0.0, max_theta, 2001)
        slope = np.array([series(angle, a)[1] for angle in theta])
        folds = np.nonzero(slope <= 0)[0]
        reached = float(theta[max(folds[0] - 1, 0)]) if len(folds) else max_theta
        return series(reached, a)[0], reached
    rho = np.linspace(0.0, WIDEST_RHO * abs(float(a[0])), 20_001)
    theta = np.array([math.atan2(r, -polynomial_kernel(r, a)[0]) for r in rho])
    folds = np.nonzero(np.diff(theta) <= 0)[0]
    fold = int(folds[0]) if len(folds) else len(rho) - 1
    if theta[fold] <= max_theta:
        return float(rho[fold]), float(theta[fold])
    return rho_of_theta(max_theta, kind, a, max_theta, float(rho[fold])), max_theta
