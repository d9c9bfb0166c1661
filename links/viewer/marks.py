"""The pieces that pictures are made of: curves, dots with words, sentences, lanes, ellipsoids.

Source: ours. Names and traps of Rerun 0.41: DESIGN, Links.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from links.viewer.ellipsoid import ellipsoid
from links.viewer.scene import Curve, Mark, Scene
from stages.geometry.frames import quaternions_xyzw

Marks = Iterator[Mark]
Colour = int | NDArray[np.uint32]

_LANE = {
    "SEARCHING": colours.NEUTRAL,
    "CANDIDATE": colours.MAYBE,
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
    "NONE": colours.NEUTRAL,
    "moves": colours.GOOD,
    "no motion": colours.NEUTRAL,
    "FULL": colours.GOOD,
    "POSITION_ONLY": colours.MAYBE,
    "fused": colours.GOOD,
    "not fused": colours.BAD,
}


def stage_of(name: str) -> str:
    """The stage or link that an output belongs to."""
    return name.split("/", 1)[0]


def lane_of(name: str) -> str:
    """Where the state of an output's stage stands."""
    return f"states/{stage_of(name)}"


def plot(
    path: str,
    values: Any,
    names: list[str],
    line_colours: NDArray[np.uint32] | None = None,
    *,
    dots: bool = True,
    steps: bool = False,
) -> Mark:
    """Curves; the few that matter have their own colours, and a dot at each sample: a lone fix is no line.

    `steps`: what was said holds until the next.
    """

    def style() -> list[Any]:
        look = {"names": names or None, "colors": line_colours}
        mode = rr.components.InterpolationMode.StepAfter if steps else None
        lines = rr.SeriesLines(**look, interpolation_mode=mode).as_component_batches()
        dotted = dots and line_colours is not None
        return [*lines, *(rr.SeriesPoints(**look).as_component_batches() if dotted else [])]

    return Curve(path, values, style=style)


def strip_batch(points: NDArray[np.float32], lengths: NDArray[np.int64]) -> pa.Array:
    """Strips for `LineStrips2D` or `LineStrips3D`: points (n, 2 or 3), strip after strip, and how many each has.

    Made at once: Rerun 0.41 makes of a list one array for each strip, and a picture has three hundred.
    """
    empty = (rr.components.LineStrip2DBatch if points.shape[1] == 2 else rr.components.LineStrip3DBatch)([])
    strips = empty.as_arrow_array().type
    flat = pa.array(points.ravel())
    rows = pa.FixedSizeListArray.from_arrays(flat, type=strips.value_type)
    ends = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), rows, type=strips)


def label(name: str, xyz_vehicle_m: NDArray[np.float64], texts: list[str], colour: Colour) -> Mark:
    """Dots with words, visible from any distance; apart from the rest, so that the close-up can do without."""
    dots = rr.Points3D(xyz_vehicle_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=texts, show_labels=True)
    return Mark(f"labels/{name}", dots, frame="vehicle")


def say(name: str, text: str, level: str = "INFO") -> Mark:
    """A sentence in the log."""
    return Mark(f"log/{name}", rr.TextLog(text, level=level))


def state(path: str, word: str, scene: Scene) -> Marks:
    """A lane changes when its word does; the same word again is no new state."""
    if scene.changed(path, word):
        yield Mark(path, rr.StateChange(state=word), style=_lane_style)


def ellipsoids(
    path: str,
    centres_vehicle_m: NDArray[np.float64],
    covariances_m2: NDArray[np.float64],
    colour: int,
    *,
    filled: bool,
) -> Mark:
    """Each of (n, 3), (n, 3, 3) holds 95 % of its Gaussian; filled thinly, or its outline only."""
    shapes = [ellipsoid(covariance) for covariance in covariances_m2]
    rotations = np.array([axes for _, axes in shapes]).reshape(-1, 3, 3)
    modes = rr.components.FillMode
    return Mark(
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


def clear(path: str) -> Mark:
    """Nothing at `path` and below any more."""
    return Mark(path, rr.Clear(recursive=True))


def _lane_style() -> rr.StateConfiguration:
    return rr.StateConfiguration(values=list(_LANE), colors=np.array(list(_LANE.values()), dtype=np.uint32))
