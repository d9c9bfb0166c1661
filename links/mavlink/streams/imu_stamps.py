"""Times of IMU messages: which of several IMU messages is used, its time since boot, and the delay of its values.

ArduPilot stamps RAW_IMU and SCALED_IMU when it sends them; the values are the newest of its main loop (400 Hz: 0 to
2.5 ms old) behind the low-pass filters INS_ACCEL_FILTER and INS_GYRO_FILTER (20 Hz, second order: sqrt(2) / (2 pi f) =
11.3 ms). Together 12.5 ms, with a jitter of 0.7 ms; the stamp here is earlier by this delay. Other filter settings have
other delays: 22.5 ms at 10 Hz. With 80 Hz for the gyro its values are 8 ms newer than assumed, 0.5 deg at 1 rad/s. PX4
stamps HIGHRES_IMU with the time of the sample; its values are the means over an integration interval of 2.5 to 5 ms,
2 ms old.

ArduPilot's SCALED_IMU and HIGHRES_IMU (since 4.6) have the values of RAW_IMU: messages of the same samples would be one
stream with wrong times. Only the first of PREFERENCE that arrives is used.

Source: https://mavlink.io/en/messages/common.html#RAW_IMU; ArduPilot GCS_MAVLINK::send_raw_imu (GCS_Common.cpp) and
AP_InertialSensor.cpp (DEFAULT_ACCEL_FILTER, DEFAULT_GYRO_FILTER), https://github.com/ArduPilot/ardupilot; PX4
src/modules/mavlink/streams/HIGHRES_IMU.hpp.
"""

from __future__ import annotations

DELAY_NS: dict[str, int] = {"RAW_IMU": 12_500_000, "SCALED_IMU": 12_500_000, "HIGHRES_IMU": 2_000_000}
"""Age of the values of an IMU message at its stamp."""

PREFERENCE = ("RAW_IMU", "HIGHRES_IMU", "SCALED_IMU")
PREFERENCE_TIMEOUT_NS = 2_000_000_000  # so long after one of them those behind it are not used


class ImuSelection:
    """Which IMU message of an autopilot is used."""

    def __init__(self) -> None:
        self._newest_ns: dict[str, int] = {}  # arrival of the newest one of each kind

    def accepts(self, kind: str, arrival_ns: int) -> bool:
        """Whether a message is used: always, unless it is an IMU message while a preferred one arrives."""
        if kind not in PREFERENCE:
            return True
        self._newest_ns[kind] = arrival_ns
        before = (self._newest_ns.get(other) for other in PREFERENCE[: PREFERENCE.index(kind)])
        return all(ns is None or arrival_ns - ns > PREFERENCE_TIMEOUT_NS for ns in before)
