"""Settings of a scene, and the corridor of the vehicle that stays free.

Source: ours.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Array64

HALF_LENGTH_M = 150.0  # beyond the LiDAR's range from the centre
KERB_HEIGHT_M = 0.12
VEHICLE_HALF_WIDTH_M = 1.0
VEHICLE_HALF_LENGTH_M = 2.4

Kind = Literal["street", "manhattan", "atlanta", "campus", "park_edge", "open_lot", "village"]
MOVERS: dict[str, tuple[int, int, int]] = {  # kind: moving cars, birds, balloons
    "street": (0, 0, 0),
    "manhattan": (3, 3, 1),
    "atlanta": (3, 3, 1),
    "campus": (1, 5, 1),
    "park_edge": (2, 7, 1),
    "open_lot": (1, 5, 1),
    "village": (0, 4, 1),
}


def _is_usual(sky: str) -> bool:
    return sky == "usual"  # scenario files leave out a setting that they do not use


class SceneSettings(StrictModel):
    """Surroundings of the vehicle. A setting that does not apply to a kind has no effect."""

    kind: Kind = "street"
    road_width_m: float = Field(default=7.5, ge=5, le=30)
    pavement_width_m: float = Field(default=3.5, ge=1.5, le=15)
    building_height_m: tuple[float, float] = (6.0, 24.0)
    side_streets: float = Field(default=0.2, ge=0, le=1)  # probability of a gap after each building
    tree_spacing_m: float = Field(default=14.0, gt=2)
    pole_spacing_m: float = Field(default=30.0, gt=5)
    parked_cars: float = Field(default=0.35, ge=0, le=1)  # fraction of occupied parking spaces
    driving_cars: int | None = Field(default=None, ge=0, le=20)  # null: default of the kind
    birds: int | None = Field(default=None, ge=0, le=50)
    balloons: int | None = Field(default=None, ge=0, le=10)
    # varied: gliding, circling and hovering birds, flocks, insects, kites and bags in place of `birds` and `balloons`
    sky: Annotated[Literal["usual", "varied"], Field(exclude_if=_is_usual)] = "usual"
    # furniture, planters, signs and boards at odd angles, oblique wires, people; windows reflect the scene
    clutter: Annotated[bool, Field(exclude_if=operator.not_)] = False
    vehicle_lane_y_m: float = -1.9  # the vehicle's start position across the street
    vehicle_yaw_deg: float = 0.0

    def movers(self) -> tuple[int, int, int]:
        """Numbers of moving cars, birds and balloons."""
        usual = MOVERS[self.kind]
        cars, birds, balloons = self.driving_cars, self.birds, self.balloons
        return (
            usual[0] if cars is None else cars,
            usual[1] if birds is None else birds,
            usual[2] if balloons is None else balloons,
        )


@dataclass(frozen=True)
class VehicleCorridor:
    """The ground that the vehicle passes over, kept free of cars, trees and poles."""

    xy_m: Array64  # (n, 2) the vehicle's path in the scene frame

    def allows(self, x_m: ArrayLike, y_m: ArrayLike, radius_m: float) -> bool:
        """Whether an object of this radius at positions x, y stays clear of the vehicle."""
        positions = np.stack(np.broadcast_arrays(x_m, y_m), axis=-1).reshape(-1, 2)
        step = np.diff(self.xy_m, axis=0)
        forward = (
            np.where(np.hypot(*step.T)[:, None] > 1e-6, step, [[1.0, 0.0]]) if len(step) else np.array([[1.0, 0.0]])
        )
        forward = np.vstack([forward, forward[-1:]])[: len(self.xy_m)]
        forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        offset = positions[:, None, :] - self.xy_m
        along = np.abs(np.einsum("pni,ni->pn", offset, forward))
        across = np.abs(offset[..., 1] * forward[:, 0] - offset[..., 0] * forward[:, 1])
        return not bool(((along < VEHICLE_HALF_LENGTH_M + radius_m) & (across < VEHICLE_HALF_WIDTH_M + radius_m)).any())
