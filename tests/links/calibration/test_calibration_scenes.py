"""`grd calibrate` on rigs that differ from their file: ten scenes, each with its own errors.

    python -m pytest -m slow -s tests/links/calibration/test_calibration_scenes.py

Each sweep is that of configs/scenarios/calibrate.yaml. The turntable's axis is tilted by up to 1 deg, the servo's stamps
are off by up to 5 ms, its encoder by 0.1 to 0.4 deg, its gear has play; the file knows nothing of it.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from stages.geometry.frames import LidarMount, Pose, quaternions_xyzw, rotation_from_rpy_deg

pytestmark = pytest.mark.slow
pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")

KINDS = ("street", "manhattan", "atlanta", "campus", "park_edge")
SCENES = 10
ORDINARY = Path(__file__).resolve().parents[3] / "configs/scenarios/calibrate.yaml"
SERVO_RAD = np.radians(np.linspace(5.0, 175.0, 341))


def off_rig(seed: int, straight: LidarMount) -> tuple[LidarMount, dict[str, float]]:
    """(How a LiDAR really sits, settings of its servo)."""
    rng = np.random.default_rng([seed, 77])
    roll, pitch = rng.uniform(-1.0, 1.0, 2)
    tilted = rotation_from_rpy_deg((roll, pitch, 0.0)) @ straight.T_turntable_lidar.matrix()[:3, :3]
    true = straight.model_copy(
        update={
            "T_turntable_lidar": Pose(
                xyz_m=straight.T_turntable_lidar.xyz_m,
                quaternion_xyzw=tuple(quaternions_xyzw(tilted[None])[0].tolist()),
            ),
            "servo_time_offset_s": float(rng.uniform(-5e-3, 5e-3)),
        }
    )
    return true, {"encoder_error_deg": float(rng.uniform(0.1, 0.4)), "backlash_deg": float(rng.uniform(0.0, 0.4))}


def axis(mount: LidarMount) -> np.ndarray:
    """The turntable's axis (3,) in the lidar frame: what turning the table cannot hide."""
    return mount.T_turntable_lidar.matrix()[2, :3]


def wave_deg(error_rad: np.ndarray) -> float:
    """RMS of an error over the servo angle without its mean, which acts like a zero offset [deg]."""
    return math.degrees(float(np.std(error_rad)))


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """(axis [deg], time [s], encoder before, after, its sigma [deg], play [deg]) of each scene."""
    from links.calibration import gather
    from links.simulated.rig.run import simulate_into
    from links.simulated.rig.scenario import load_scenario
    from links.simulated.sensors.servo import GearTrain
    from stages.calibration.calibrate import calibrate

    rows = []
    for seed in range(1, SCENES + 1):
        ordinary = load_scenario(ORDINARY)
        true, servo = off_rig(seed, ordinary.rig.mount)
        scenario = ordinary.changed(
            seed=seed,
            scene=ordinary.scene.model_copy(update={"kind": KINDS[seed % len(KINDS)]}),
            true_mount=true,
            servo=ordinary.servo.model_copy(update=servo),
        )
        recording = tmp_path_factory.mktemp("scene") / f"s{seed}.mcap"
        simulate_into(recording, scenario)
        gathered = gather(recording, None, (0.0, math.inf))
        result = calibrate(gathered.returns, gathered.trace, gathered.mount)
        turned = GearTrain(scenario.servo, seed)
        wrong = np.array([turned.encoder_error_rad(p) for p in SERVO_RAD])
        left = result.mount.turntable_rad(SERVO_RAD) - (SERVO_RAD - wrong)
        off_s = result.mount.servo_time_offset_s - true.servo_time_offset_s
        rows.append(
            (
                math.degrees(math.acos(min(1.0, float(axis(result.mount) @ axis(true))))),
                off_s,
                wave_deg(wrong),
                wave_deg(left),
                math.degrees(result.curve_sigma_rad),
                result.mount.servo_play_deg - servo["backlash_deg"],
            )
        )
        sys.stdout.write(f"\n{scenario.scene.kind:10} seed {seed}: " + " ".join(f"{v:.5f}" for v in rows[-1]))
    return np.array(rows)


def test_the_axis_the_clock_and_the_encoder_are_found(found):
    axis_deg, time_s, before_deg, after_deg, sigma_deg, _ = found.T
    better = before_deg / after_deg
    sys.stdout.write(
        f"\naxis {np.median(axis_deg):.4f}, worst {axis_deg.max():.4f} deg; time {1e3 * np.median(np.abs(time_s)):.3f}, "
        f"worst {1e3 * np.abs(time_s).max():.3f} ms; encoder error {np.median(better):.0f} times smaller, least {better.min():.0f}, "
        f"worst {(after_deg / sigma_deg).max():.1f} of its sigma\n"
    )
    assert axis_deg.max() < 0.05
    assert np.abs(time_s).max() < 2e-4
    assert np.median(better) >= 5.0
    assert (after_deg < 2.5 * sigma_deg).all()
