"""The yaw of the drone's body as a set of hypotheses with probabilities."""

from __future__ import annotations

from flow.message import Message, PerPointF64, message


@message(schema=81)
class HeadingEstimate(Message):
    """Yaw of the drone's body at stamp_ns: a mixture of normal distributions on the circle.

    The yaw is the rotation about the vertical of R_map_drone. In `vehicle` it is less by the vehicle's yaw in `map`.
    """

    yaw_map_rad: PerPointF64  # of each hypothesis, most probable first; empty: no drone is followed
    sigma_rad: PerPointF64
    probability: PerPointF64  # sums to 1
    vehicle_yaw_rad: float  # yaw of R_map_vehicle at stamp_ns
    near_probability: float  # probability of a yaw within 20 deg of the best one; 10 deg with cameras
    decided: bool  # near_probability has exceeded 0.999 for 0.8 s and the object is the drone
    reason: str  # what the estimate rests on, or why it is not decided

    @property
    def yaw_vehicle_rad(self) -> PerPointF64:
        """Yaw of the body in `vehicle`, of each hypothesis."""
        return self.yaw_map_rad - self.vehicle_yaw_rad
