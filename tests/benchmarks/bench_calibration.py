"""A round of the calibration: planes projected out of all patches at once, compared with a least squares per patch.

python -m pytest tests/benchmarks/bench_calibration.py
"""

from __future__ import annotations

import numpy as np
import pytest

from stages.calibration.calibrate import calibrate
from stages.calibration.patches import find_patches
from stages.calibration.solve import without_planes
from tests.stages.calibration.made_sweep import RIG, sweep, wrong_mount


@pytest.fixture(scope="module")
def found():
    made = sweep(wrong_mount())
    return made, calibrate(made.returns, made.trace, RIG)


def columns_of(found):
    patches = found[1].patches
    rng = np.random.default_rng(0)
    return rng.normal(size=(len(patches.index), 28)), rng.uniform(0.5, 2, len(patches.index)), patches


def test_planes_of_all_patches_at_once(benchmark, found):
    benchmark(without_planes, *columns_of(found))


def test_planes_patch_by_patch(benchmark, found):
    columns, weight, patches = columns_of(found)

    def one_by_one():
        left = columns * weight[:, None]
        for part in np.split(np.arange(len(weight)), patches.first[1:]):
            basis = patches.plane_basis[part] * weight[part, None]
            left[part] -= basis @ np.linalg.lstsq(basis, left[part], rcond=None)[0]
        return left

    assert benchmark(one_by_one) == pytest.approx(without_planes(columns, weight, patches), abs=1e-6)


def test_patches_of_a_sweep(benchmark, found):
    after = found[1].after
    benchmark(find_patches, after.xyz_m, after.origin_m, 0.003)


def test_a_whole_calibration_of_40_000_returns(benchmark, found):
    made, _ = found
    benchmark.pedantic(calibrate, (made.returns, made.trace, RIG), rounds=3)
