"""Compares the simulated VLP-16 with real captures, and the simulated drones with a real one.

    python -m links.simulated.matrix.sim_vs_real            prints the table of recordings/README.md

All figures of a cloud are computed from decoded packets by the same function, real or simulated. The real captures were
made indoors, so the simulated one is, too. The real drone (UG2+/MMAUD) was recorded with a Livox Mid-360, another
scanner: hits are compared as an effective area, hits / (pulses per steradian) * range^2, which does not depend on the
density of the scanner. Its 20 000 pulses per frame are assumed uniform over its field of view.

Source: ours; Livox Mid-360 user manual v1.2 (200 000 points/s, 360 deg x -7..52 deg).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flow.link import Record
from links.lidar import Lidar as Decoder
from links.recording import RecordingReader
from links.simulated.kernels.lidar import echoes
from links.simulated.kernels.ray_casting import Array32
from links.simulated.sensors.lidar import FINE, Lidar, LidarSettings, sub_rays
from links.simulated.sensors.lidar_packets import PacketEncoder
from links.simulated.world.drone import DroneModel, drone_mesh
from links.simulated.world.mesh import Mesh, RayScene
from links.simulated.world.procedural.indoor import indoor_mesh
from stages.geometry.frames import Array64
from stages.geometry.lidar_models import lidar_profile
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings

START_NS = 1_748_773_230_000_000_000
WINDOW = 15  # firings of one laser, 3 deg: within it the range of a wall is a parabola
FLAT_M = 0.03  # largest residual of a flat patch
LASERS = lidar_profile("VLP-16").lasers
UPPER_LASERS = np.arange(1, LASERS, 2)  # at +1 deg and above: clear of table and vehicle
MID360_PULSES = 20_000  # per frame of 0.1 s
MID360_VIEW_SR = 2 * np.pi * (np.sin(np.radians(52)) - np.sin(np.radians(-7)))
NEAR_DRONE_M = 0.6
DRONES = ((0.35, "folding"), (0.5, "x4"), (0.8, "hexa"))


@dataclass(frozen=True)
class CloudFigures:
    """Figures of a capture."""

    pulses_per_turn: float
    returns_per_turn: float
    upper_returned: float  # fraction of the pulses at +1 deg and above with a return
    spacing_mrad: float  # between neighbours on one surface
    isolated_dropouts: float  # fraction of pulses without return between two returns of one surface
    mixed: float  # fraction of returns between the surfaces of their two neighbours
    noise_m: float  # median residual on flat patches
    noise_90_m: float
    patches: int
    laser_bias_m: float  # spread of the mean residuals of the lasers on planes
    reflectivity: tuple[float, float, float]  # 5, 50, 95 %


def measure(firings: Iterable[LidarFirings]) -> CloudFigures:
    """Figures of a capture in strongest mode."""
    packets = list(firings)
    ranges, azimuth = (
        np.concatenate([getattr(p, name) for p in packets]).astype(np.float64).reshape(-1, LASERS)
        for name in ("range_m", "azimuth_rad")
    )
    shade = np.concatenate([p.reflectivity for p in packets]).reshape(-1, LASERS)
    points = np.concatenate([p.xyz_lidar_m for p in packets]).reshape(-1, LASERS, 3).astype(np.float64)
    turns = float(np.ptp(np.unwrap(azimuth[:, 0]))) / (2 * np.pi)
    returned = ranges > 0
    before, here, after = ranges[:-2], ranges[1:-1], ranges[2:]
    one_surface = (before > 0) & (after > 0) & (np.abs(after - before) < 0.05)
    low, high = np.minimum(before, after), np.maximum(before, after)
    mixed = (before > 0) & (after > 0) & (here > low + 0.1) & (here < high - 0.1)
    step = np.linalg.norm(points[1:] - points[:-1], axis=2)
    level = (ranges[1:] > 0) & (ranges[:-1] > 0) & (np.abs(ranges[1:] - ranges[:-1]) < 0.004)
    residual = _patch_residuals(ranges)
    return CloudFigures(
        pulses_per_turn=ranges.size / turns,
        returns_per_turn=float(returned.sum()) / turns,
        upper_returned=float(returned[:, UPPER_LASERS].mean()),
        spacing_mrad=1e3 * float(np.median(step[level] / ranges[1:][level])),
        isolated_dropouts=float((here[one_surface] == 0).mean()),
        mixed=float(mixed.sum() / returned.sum()),
        noise_m=float(np.median(residual)),
        noise_90_m=float(np.quantile(residual, 0.9)),
        patches=len(residual),
        laser_bias_m=_laser_bias_m(points, returned),
        reflectivity=tuple(np.quantile(shade[returned], [0.05, 0.5, 0.95]).tolist()),
    )


def _patch_residuals(ranges: Array64) -> Array64:
    """Residual (p,) of a parabola through each full, flat window of one laser, with its degrees of freedom."""
    t = np.linspace(-1, 1, WINDOW)
    basis = np.linalg.qr(np.column_stack([np.ones(WINDOW), t, t**2]))[0]
    whole = ranges[: len(ranges) // WINDOW * WINDOW].reshape(-1, WINDOW, LASERS).transpose(0, 2, 1)
    windows = whole.reshape(-1, WINDOW)
    windows = windows[(windows > 0).all(axis=1) & (np.ptp(windows, axis=1) < 0.3)]
    left = windows - windows @ basis @ basis.T
    residual = np.sqrt((left**2).sum(axis=1) / (WINDOW - 3))
    return residual[residual < FLAT_M]


def _laser_bias_m(points: Array64, returned: NDArray[np.bool_]) -> float:
    """Spread over the lasers of their mean distance from planes through patches of 2 windows and all lasers."""
    offsets: list[list[float]] = [[] for _ in range(LASERS)]
    size = 2 * WINDOW
    for first in range(0, len(points) - size, size):
        patch, there = points[first : first + size], returned[first : first + size]
        if there.all(axis=0).sum() < 6:
            continue
        lasers = np.nonzero(there.all(axis=0))[0]
        cloud = patch[:, lasers]
        centre = cloud.reshape(-1, 3).mean(axis=0)
        normal = np.linalg.svd(cloud.reshape(-1, 3) - centre, full_matrices=False)[2][2]
        away = (cloud - centre) @ normal
        if away.std() < FLAT_M and np.abs(centre @ normal) > 0.8 * np.linalg.norm(centre):
            for laser, mean in zip(lasers, away.mean(axis=0) / np.abs(normal @ centre) * np.linalg.norm(centre),
                                   strict=True):  # fmt: skip
                offsets[laser].append(float(mean))
    means = [float(np.median(o)) for o in offsets if len(o) >= 5]
    return float(np.std(means)) if len(means) >= 4 else float("nan")


def recorded(path: Path) -> Iterator[LidarFirings]:
    """The decoded packets of a recording."""
    decoder = Decoder()
    with RecordingReader(path) as reader:
        for record in reader.records():
            if record.topic == "/lidar/packets" and (firings := decoder.decode(record)) is not None:
                yield firings


class StaticScene:
    """A scene without motion."""

    def __init__(self, mesh: Mesh) -> None:
        self._scene = RayScene(mesh)

    def cast(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32, max_range_m: float
    ) -> tuple[Array32, Array32, NDArray[np.uint8]]:
        """See `lidar.Environment`."""
        rays = directions_world.shape[:2]
        found = self._scene.cast(origins_world_m.reshape(-1, 3), directions_world.reshape(-1, 3), max_range_m)
        return found[0].reshape(rays), found[1].reshape(rays), np.zeros(rays, dtype=np.uint8)

    def near_small_body(
        self, pulse_ns: NDArray[np.int64], origins_world_m: Array32, directions_world: Array32
    ) -> NDArray[np.bool_]:
        """See `lidar.Environment`."""
        return np.zeros(len(pulse_ns), dtype=np.bool_)


def simulated_indoor_scene(turns: float, seed: int = 1) -> Iterator[LidarFirings]:
    """An upright LiDAR 1 m above the floor of the room, through packets and decoder like the real one."""
    lidar, environment, decoder = (
        Lidar(LidarSettings(), START_NS, seed),
        StaticScene(indoor_mesh(1.0, seed)),
        Decoder(),
    )
    encoder = PacketEncoder(RigLidar(), "strongest")
    for packet in range(int(turns * 1e8 / encoder.packet_ns)):
        first_ns = START_NS + packet * encoder.packet_ns
        sequence_ns = first_ns + encoder.sequence_offsets_ns(1)
        pulse_ns = (sequence_ns[:, None] + np.array(encoder.profile.firing_ns)).ravel()
        level = np.broadcast_to(np.eye(3), (len(pulse_ns), 3, 3)).copy()
        pulses = lidar.fire(pulse_ns, level, np.zeros((len(pulse_ns), 3)), environment)
        shape = (1, encoder.sequences, LASERS)
        ranges, shades = pulses.range_m.reshape(shape), pulses.reflectivity.reshape(shape)
        data = encoder.encode(first_ns, lidar.azimuth_rad(sequence_ns), ranges, shades)
        record = Record("/lidar/packets", arrival_ns=first_ns + 2_000_000, stamp_ns=first_ns, data=data)
        decoded = decoder.decode(record)
        if decoded is not None:
            yield decoded


def drone_area_m2(mesh: Mesh, from_m: Array64, step_rad: float = 4e-3) -> float:
    """Effective area: solid angle of the pulses that a VLP-16 gets back from the drone, times range^2.

    The pulses form a square grid of directions around the drone at the origin, from a position (3,).
    """
    range_m = float(np.linalg.norm(from_m))
    forward = -from_m / range_m
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.95 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    half = np.arctan2(1.2 * np.linalg.norm(mesh.vertices_m, axis=1).max(), range_m)
    u, v = (g.ravel() for g in np.meshgrid(*2 * [np.arange(-half, half, step_rad)]))
    axis = forward + np.tan(u)[:, None] * side + np.tan(v)[:, None] * up
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = np.cross(axis, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    aim = np.stack([across, axis, np.cross(across, axis)], axis=2)  # the laser's axis is +y, except for its 1 deg
    origin = np.tile(from_m, (len(axis), 1))
    elevated = np.radians(1.0)
    tilt = np.array([[1, 0, 0], [0, np.cos(elevated), np.sin(elevated)], [0, -np.sin(elevated), np.cos(elevated)]])
    laser = np.full(len(axis), 1)
    origins, directions = sub_rays(np.zeros(len(axis)), laser, aim @ tilt, origin, FINE.offsets)
    shape = directions.shape[:2]
    ranges, fractions = RayScene(mesh).cast(origins.reshape(-1, 3), directions.reshape(-1, 3), 200.0)
    profile = lidar_profile("VLP-16")
    threshold = np.full(len(axis), 0.10 / profile.range_at_10_percent_m**2)
    returned = (ranges.reshape(shape), fractions.reshape(shape), np.zeros(shape, dtype=np.uint8))
    found = echoes(*returned, FINE.shares, threshold, profile.min_range_m, "strongest")[0][0] > 0
    return float(found.sum()) * step_rad**2 * range_m**2


@dataclass(frozen=True)
class DroneFigures:
    """A real drone in clouds of the Mid-360."""

    frames: int
    range_m: tuple[float, float]
    hits: float  # median per frame
    area_m2: tuple[float, float, float]  # 10, 50, 90 % over frames
    extent_m: float  # median over frames of the extent along the widest direction, 5 to 95 %
    positions_m: Array64  # (frames, 3) drone minus sensor


def real_drone(folder: Path) -> DroneFigures:
    """Hits on the real drone, around its (unofficial) track."""
    track = np.genfromtxt(folder / "track_by_ug2_winner_NOT_official_gt.csv", delimiter=",", skip_header=1)
    clouds = np.load(folder / "ug2_val_seq1_lidar_360.npz")
    hits, extents, positions = [], [], []
    for key in clouds:
        if track[0, 0] <= float(key) <= track[-1, 0]:
            position = np.array([np.interp(float(key), track[:, 0], track[:, i]) for i in (1, 2, 3)])
            cloud = clouds[key][np.linalg.norm(clouds[key] - position, axis=1) < NEAR_DRONE_M]
            positions.append(position)
            hits.append(len(cloud))
            widest = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)[2][0]
            extents.append(float(np.ptp(np.quantile(cloud @ widest, [0.05, 0.95]))))
    away = np.linalg.norm(positions, axis=1)
    area = np.array(hits) * MID360_VIEW_SR / MID360_PULSES * away**2
    low, middle, high = np.quantile(area, [0.1, 0.5, 0.9]).tolist()
    return DroneFigures(
        frames=len(hits),
        range_m=(float(away.min()), float(away.max())),
        hits=float(np.median(hits)),
        area_m2=(low, middle, high),
        extent_m=float(np.median(extents)),
        positions_m=np.array(positions),
    )


def cloud_table(captures: dict[str, CloudFigures]) -> str:
    """The figures of all captures, as a Markdown table."""
    rows = {
        "pulses per revolution": [f"{c.pulses_per_turn:.0f}" for c in captures.values()],
        "returns per revolution": [f"{c.returns_per_turn:.0f}" for c in captures.values()],
        "returned, lasers at +1 deg and above": [f"{100 * c.upper_returned:.1f} %" for c in captures.values()],
        "spacing of neighbours on a surface [mrad]": [f"{c.spacing_mrad:.2f}" for c in captures.values()],
        "isolated dropouts within a surface": [f"{100 * c.isolated_dropouts:.2f} %" for c in captures.values()],
        "mixed pixels between two surfaces": [f"{100 * c.mixed:.2f} %" for c in captures.values()],
        "range noise on flat patches, median [mm]": [f"{1e3 * c.noise_m:.1f}" for c in captures.values()],
        "the same, 90 % [mm]": [f"{1e3 * c.noise_90_m:.1f}" for c in captures.values()],
        "flat patches": [str(c.patches) for c in captures.values()],
        "bias between lasers, 1 sigma [mm]": [f"{1e3 * c.laser_bias_m:.1f}" for c in captures.values()],
        "reflectivity 5, 50, 95 %": ["{:.0f}, {:.0f}, {:.0f}".format(*c.reflectivity) for c in captures.values()],
    }
    head = ["", *captures]
    lines = [head, ["---"] * len(head), *([name, *cells] for name, cells in rows.items())]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def drone_table(real: DroneFigures) -> str:
    """Effective areas of the real drone and of simulated ones from the same directions, as a Markdown table."""
    lines = [
        "| drone | effective area 10, 50, 90 % [cm^2] |",
        "| --- | --- |",
        f"| real, {real.frames} frames at {real.range_m[0]:.1f} to {real.range_m[1]:.1f} m, "
        f"{real.hits:.0f} hits per frame, {real.extent_m:.2f} m wide | {_cm2(real.area_m2)} |",
    ]
    for span_m, shape in DRONES:
        mesh = drone_mesh(span_m, 0.4, DroneModel.model_validate({"shape": shape}))
        areas = [drone_area_m2(mesh, -position, 8e-3) for position in real.positions_m[::4]]
        low, middle, high = np.quantile(areas, [0.1, 0.5, 0.9]).tolist()
        lines.append(f"| simulated, {span_m} m {shape} | {_cm2((low, middle, high))} |")
    return "\n".join(lines)


def _cm2(area_m2: tuple[float, float, float]) -> str:
    return ", ".join(f"{1e4 * a:.0f}" for a in area_m2)


def comparison_table(recordings: Path, shared: Path) -> str:
    """Both tables; without the shared drone clouds (`drone_lidar`), a note instead of the second."""
    captures = {
        "einride (real)": measure(recorded(recordings / "einride_vlp16.mcap")),
        "mrpt (real)": measure(recorded(recordings / "mrpt_vlp16_gps.mcap")),
        "room (simulated)": measure(simulated_indoor_scene(13.0)),
    }
    folder = shared / "drone_lidar"
    drones = drone_table(real_drone(folder)) if folder.exists() else f"The real drone clouds are missing ({folder})."
    return cloud_table(captures) + "\n\n" + drones + "\n"


if __name__ == "__main__":
    root = Path(__file__).resolve().parents[3]
    sys.stdout.write(comparison_table(root / "recordings", root.parent / "shared" / "data"))
