"""Times of IMU messages: which of several IMU messages is used, its time since boot, and the delay of its values.

ArduPilot stamps RAW_IMU and SCALED_IMU when it sends them; the values are the newest of its main loop (400 Hz: 0 to
2.5 ms old) behind the low-pass filters INS_ACCEL_FILTER and INS_GYRO_FILTER (20 Hz, second order: sqrt(2) / (2 pi f) =
11.3 ms). Together 12.5 ms, with a jitter of 0.7 ms; the stamp here is earlier by this delay. Other filter settings have
other delays: 22.5 ms at 10 Hz. PX4 stamps HIGHRES_IMU with the time of the sample; its values are the means over an
integration interval of 2.5 to 5 ms, 2 ms old.

Older versions of ArduPilot take RAW_IMU's time from a 32-bit counter of microseconds, which starts again after
71.6 min.

ArduPilot's SCALED_IMU has the values of RAW_IMU: two messages of the same samples would be one stream with wrong times.
Only one is used, RAW_IMU or HIGHRES_IMU if it arrives.

Source: https://mavlink.io/en/messages/common.html#RAW_IMU; ArduPilot GCS_MAVLINK::send_raw_imu (GCS_Common.cpp) and
AP_InertialSensor.cpp (DEFAULT_ACCEL_FILTER, DEFAULT_GYRO_FILTER), https://github.com/ArduPilot/ardupilot; PX4
src/modules/mavlink/streams/HIGHRES_IMU.hpp.
"""

from __future__ import annotations

DELAY_NS: dict[str, int] = {"RAW_IMU": 12_500_000, "SCALED_IMU": 12_500_000, "HIGHRES_IMU": 2_000_000}
"""Age of the values of an IMU message at its stamp."""

PREFERRED = ("RAW_IMU", "HIGHRES_IMU")
PREFERENCE_TIMEOUT_NS = 2_000_000_000  # so long after one of them SCALED_IMU is not used
COUNTER_US = 2**32


class ImuSelection:
    """Which IMU message of an autopilot is used."""

    def __init__(self) -> None:
        self._preferred_ns: int | None = None  # arrival of the newest preferred message

    def accepts(self, kind: str, arrival_ns: int) -> bool:
        """Whether a message is used: always, unless it is an IMU message while a preferred one arrives."""
        if kind in PREFERRED:
            self._preferred_ns = arrival_ns
        elif kind == "SCALED_IMU":
            return self._preferred_ns is None or arrival_ns - self._preferred_ns > PREFERENCE_TIMEOUT_NS
        return True


def time_since_boot_us(kind: str, time_usec: int, expected_us: int | None) -> int:
    """RAW_IMU's time since boot without the steps of a 32-bit counter: the one nearest to `expected_us`, if known."""
    if kind != "RAW_IMU" or time_usec >= COUNTER_US or expected_us is None or expected_us < COUNTER_US // 2:
        return time_usec
    return time_usec + COUNTER_US * round((expected_us - time_usec) / COUNTER_US)
