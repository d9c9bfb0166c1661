"""The two trajectory errors that the field compares itself by, as `evo` computes them.

Source: evo 1.38 (github.com/MichaelGrupp/evo), metrics.APE and metrics.RPE; truth is interpolated to the outputs'
stamps first, and nothing is aligned: the vehicle frame is given, an offset in it is an error.
"""

from __future__ import annotations

import numpy as np

from links.evaluation.errors import AtOutputs

INSTALL = "evo is not installed: pip install -e '.[evaluate]'"


def evo_errors(at: AtOutputs, estimate_xyz_m: np.ndarray) -> dict[str, float] | str:
    """RMSE of APE and RMSE and max of RPE over one output [m]; or the reason why there are none.

    At least two outputs are needed.
    """
    try:
        from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
        from evo.core.trajectory import PoseTrajectory3D
    except ModuleNotFoundError:
        return INSTALL
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(at.index), 1))  # w x y z; the translation alone is compared
    stamps_s = (at.stamps_ns - at.stamps_ns[0]) / 1e9
    truth = PoseTrajectory3D(at.true_xyz_m, upright, stamps_s)
    estimate = PoseTrajectory3D(estimate_xyz_m, upright, stamps_s)
    ape = APE(PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    rpe = RPE(PoseRelation.translation_part, delta=1, delta_unit=Unit.frames, all_pairs=True)
    rpe.process_data((truth, estimate))
    return {
        "evo_ape_rmse_m": float(ape.get_statistic(StatisticsType.rmse)),
        "evo_rpe_rmse_m": float(rpe.get_statistic(StatisticsType.rmse)),
        "evo_rpe_max_m": float(rpe.get_statistic(StatisticsType.max)),
    }
