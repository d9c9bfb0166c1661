"""Building blocks of a drawing: entities with archetypes, curves, labels, log entries, state lanes, ellipsoids.

Source: ours, for the API of Rerun 0.41; DESIGN, Links.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from stages.geometry.frames import quaternions_xyzw


class StateMemory(Protocol):
    """The part of the scene that remembers the last value of each state."""

    def changed(self, path: str, value: str) -> bool:
        """Whether `value` differs from the last one of `path`; stores it."""
        ...


CHI2_3D_95 = 7.814727903  # 95 % quantile of the chi-square distribution with 3 degrees of freedom

_STATE_COLOURS = {
    "SEARCHING": colours.NEUTRAL,
    "CANDIDATE": colours.CANDIDATE,
    "TRACKING": colours.GOOD,
    "COASTING": colours.COASTING,
    "LOST": colours.BAD,
    "drone": colours.GOOD,
    "no drone": colours.NEUTRAL,
    "ok": colours.GOOD,
    "packets lost": colours.BAD,
    "directions": colours.GOOD,
    "no directions": colours.NEUTRAL,
    "RESOLVED": colours.GOOD,
    "AMBIGUOUS": colours.COASTING,
    "OPEN": colours.COASTING,
    "NONE": colours.NEUTRAL,
    "moves": colours.GOOD,
    "no motion": colours.NEUTRAL,
    "FULL": colours.GOOD,
    "accepted": colours.GOOD,
    "POSITION_ONLY": colours.CANDIDATE,
    "fused": colours.GOOD,
    "not fused": colours.BAD,
}


class Entity:
    """Archetypes to log at an entity path, in a named frame. `style` is evaluated and logged once per path, static."""

    __slots__ = ("archetypes", "frame", "path", "style")

    def __init__(
        self, path: str, *archetypes: Any, frame: str | None = None, style: Callable[[], Any] | None = None
    ) -> None:
        self.path = path
        self.archetypes = archetypes
        self.frame = frame
        self.style = style


class Curve(Entity):
    """Numbers (n,) to plot at an entity path."""

    __slots__ = ("values",)

    def __init__(self, path: str, values: Any, style: Callable[[], Any] | None = None) -> None:
        super().__init__(path, style=style)
        self.values = np.asarray(values, dtype=np.float64).ravel()


Entities = Iterator[Entity]
Colour = int | NDArray[np.uint32]


def stage_of(name: str) -> str:
    """The stage or link that produces the output `name`."""
    return name.split("/", 1)[0]


def state_path(name: str) -> str:
    """Entity path of the state lane of the stage that produces the output `name`."""
    return f"states/{stage_of(name)}"


def plot(
    path: str,
    values: Any,
    names: list[str],
    line_colours: NDArray[np.uint32] | None = None,
    *,
    dots: bool = True,
    steps: bool = False,
) -> Entity:
    """Curves of `values` (n,). With `line_colours`, `dots` marks each sample, because a single sample draws no line.

    `steps`: a value holds until the next sample.
    """

    def style() -> list[Any]:
        shared = {"names": names or None, "colors": line_colours}
        mode = rr.components.InterpolationMode.StepAfter if steps else None
        lines = rr.SeriesLines(**shared, interpolation_mode=mode).as_component_batches()
        dotted = dots and line_colours is not None
        return [*lines, *(rr.SeriesPoints(**shared).as_component_batches() if dotted else [])]

    return Curve(path, values, style=style)


def strip_batch(points: NDArray[np.float32], lengths: NDArray[np.int64]) -> pa.Array:
    """Strips for `LineStrips2D` or `LineStrips3D` from concatenated points (n, 2 or 3) and the length of each strip.

    Builds one Arrow array. Rerun 0.41 converts a list of strips one by one, and an image has about three hundred.
    """
    empty = (rr.components.LineStrip2DBatch if points.shape[1] == 2 else rr.components.LineStrip3DBatch)([])
    strips = empty.as_arrow_array().type
    flat = pa.array(points.ravel())
    rows = pa.FixedSizeListArray.from_arrays(flat, type=strips.value_type)
    ends = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), rows, type=strips)


def label(name: str, xyz_vehicle_m: NDArray[np.float64], texts: list[str], colour: Colour) -> Entity:
    """Labelled points, visible from any distance, in a group of their own that the close-up view leaves out."""
    dots = rr.Points3D(xyz_vehicle_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=texts, show_labels=True)
    return Entity(f"labels/{name}", dots, frame="vehicle")


def log_entry(name: str, text: str, level: str = "INFO") -> Entity:
    """An entry of the text log."""
    return Entity(f"log/{name}", rr.TextLog(text, level=level))


def state_change(path: str, value: str, scene: StateMemory) -> Entities:
    """The new value of a state lane; nothing when it equals the last one."""
    if scene.changed(path, value):
        yield Entity(path, rr.StateChange(state=value), style=_state_style)


def ellipsoids(
    path: str,
    centres_vehicle_m: NDArray[np.float64],
    covariances_m2: NDArray[np.float64],
    colour: int,
    *,
    filled: bool,
) -> Entity:
    """95 % ellipsoids of Gaussians with means (n, 3) and covariances (n, 3, 3); transparent fill, or outline only."""
    shapes = [ellipsoid(covariance) for covariance in covariances_m2]
    rotations = np.array([axes for _, axes in shapes]).reshape(-1, 3, 3)
    modes = rr.components.FillMode
    return Entity(
        path,
        rr.Ellipsoids3D(
            centers=centres_vehicle_m,
            half_sizes=np.array([half_sizes for half_sizes, _ in shapes]).reshape(-1, 3),
            quaternions=[rr.Quaternion(xyzw=q) for q in quaternions_xyzw(rotations)],
            colors=colour,
            fill_mode=modes.TransparentFillMajorWireframe if filled else modes.MajorWireframe,
        ),
        frame="vehicle",
    )


def ellipsoid(covariance_m2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half sizes (3,) [m] and axes (columns of a rotation) of the ellipsoid that contains 95 % of a Gaussian.

    half_i = sqrt(chi2_3(0.95) lambda_i) along eigenvector i of the covariance.
    """
    eigenvalues, axes = np.linalg.eigh(covariance_m2)
    if np.linalg.det(axes) < 0:
        axes = axes * [1.0, 1.0, -1.0]
    return np.sqrt(CHI2_3D_95 * np.maximum(eigenvalues, 0.0)), axes


def clear(path: str) -> Entity:
    """Removes what is drawn at `path` and below it."""
    return Entity(path, rr.Clear(recursive=True))


def slashed(values: NDArray[np.float64], decimals: int) -> str:
    """Numbers separated by slashes, without a negative zero."""
    return " / ".join(f"{round(value, decimals) + 0.0:.{decimals}f}" for value in values.tolist())


def _state_style() -> rr.StateConfiguration:
    return rr.StateConfiguration(
        values=list(_STATE_COLOURS), colors=np.array(list(_STATE_COLOURS.values()), dtype=np.uint32)
    )
