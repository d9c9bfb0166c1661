"""Propagation of hypotheses by one preintegrated motion: states and error covariances.

Errors (15): theta, position, velocity, accelerometer bias, gyroscope bias; stages/heading/inertial_state.py.

    theta' = dR^T theta + J_theta b,   v' = v - R [dv]x theta + R J_v b,   p' = p + T v - R [dp]x theta + R J_p b

Source: Forster et al. (T-RO 2017), eq. 44 and appendix.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once
from stages.kernels.geometry.so3 import exp_rotation, hat

MATRICES, VECTORS = "float64[:, :, ::1]", "float64[:, ::1]"
TYPES = (
    f"({MATRICES}, {VECTORS}, {VECTORS}, {VECTORS}, {MATRICES}, float64[:, ::1], float64[::1], float64[::1], "
    "float64[:, ::1], float64[:, ::1], float64[::1], float64, float64[::1], float64[::1])"
)


@compiled_at_once(TYPES)
def predict_states(
    R: Array64,
    xyz_m: Array64,
    velocity_mps: Array64,
    bias: Array64,
    covariance: Array64,
    dR: Array64,
    dv: Array64,
    dp: Array64,
    J: Array64,
    C: Array64,
    mean_bias: Array64,
    seconds: float,
    gravity_mps2: Array64,
    walk: Array64,
) -> tuple[Array64, Array64, Array64, Array64]:
    """R, position, velocity and covariance of n hypotheses after a motion (see `preintegrate`) over `seconds`.

    R (n, 3, 3), vectors (n, 3), bias (n, 6), covariance (n, 15, 15); walk (15,): variances that are added.
    """
    n, T = R.shape[0], seconds
    R_out, xyz_out, v_out, P_out = (
        np.empty_like(R),
        np.empty_like(xyz_m),
        np.empty_like(xyz_m),
        np.empty_like(covariance),
    )
    for k in range(n):
        correction = J @ (bias[k] - mean_bias)
        turn = dR @ exp_rotation(correction[:3])
        dv_k, dp_k = dv + correction[3:6], dp + correction[6:]
        R_k = R[k].copy()
        F = np.eye(15)
        F[:3, :3] = turn.T
        F[3:6, :3] = -(R_k @ hat(dp_k))
        F[6:9, :3] = -(R_k @ hat(dv_k))
        for i in range(3):
            F[3 + i, 6 + i] = T
        F[:3, 9:] = J[:3]
        F[3:6, 9:] = R_k @ J[6:]
        F[6:9, 9:] = R_k @ J[3:6]
        G = np.zeros((15, 9))
        for i in range(3):
            G[i, i] = 1.0
        G[6:9, 3:6] = R_k
        G[3:6, 6:] = R_k
        P = F @ covariance[k].copy() @ F.T + G @ C @ G.T
        P_out[k] = 0.5 * (P + P.T)
        for i in range(15):
            P_out[k, i, i] += walk[i]
        R_out[k] = R_k @ turn
        xyz_out[k] = xyz_m[k] + T * velocity_mps[k] + 0.5 * T * T * gravity_mps2 + R_k @ dp_k
        v_out[k] = velocity_mps[k] + T * gravity_mps2 + R_k @ dv_k
    return R_out, xyz_out, v_out, P_out
