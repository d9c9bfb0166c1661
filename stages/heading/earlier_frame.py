"""The drone's heading and the autopilot's axes since before an interruption, while the frame may be the same.

    restart of grd                    the drone by the autopilot, in the `map` of the earlier run
    outage of the vehicle's motion    its newest state before, propagated by its IMU (`map_outage.py`)

LiDAR positions are compared with the prior of their time (`same_frame.py`).

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque

from stages.geometry.frames import Array64
from stages.heading.map_outage import KnownState, MapOutage
from stages.heading.odometry_heading import OdomYaw
from stages.heading.same_frame import PriorHeading, SameFrame
from stages.messages import DroneMotion, HeadingPrior

RESTART_PRIORS = 64  # newest ones kept: LiDAR positions wait for their time, priors come at up to 50 Hz


class EarlierFrame:
    """What is known in the frame before the newest interruption."""

    def __init__(self, changed_frames: float) -> None:
        """Share of interruptions after which the frame is another one."""
        self._changed_frames = changed_frames
        self._same_frame = SameFrame(changed_frames, math.pi)
        self._outage = MapOutage()
        self._restart_priors: deque[HeadingPrior] = deque(maxlen=RESTART_PRIORS)
        self._of_earlier_run = True  # `map` may be that of an earlier run

    def add_motion(self, motion: DroneMotion) -> None:
        """Add an interval of the drone's IMU, also during an outage."""
        self._outage.add_motion(motion)

    def add_restart_prior(self, prior: HeadingPrior) -> None:
        """Add the drone by the autopilot since an earlier run, in the `map` of then."""
        if self._of_earlier_run:
            self._restart_priors.append(prior)

    def add_state(self, known: KnownState) -> None:
        """Add a state with a known heading: the one of before the next outage."""
        self._outage.add_state(known)

    def add_position(
        self,
        stamp_ns: int,
        xyz_map_m: Array64,
        covariance_m2: Array64,
        velocity_map_mps: Array64 | None,
        vehicle_map_m: Array64,
    ) -> None:
        """Compare a LiDAR position (3,) with the prior of its time; the velocity (3,) is the tracker's, if known."""
        outage = self._outage.prior(stamp_ns)
        nearest = min(self._restart_priors, key=lambda prior: abs(prior.stamp_ns - stamp_ns), default=None)
        about_m = None if outage is None else vehicle_map_m
        self._same_frame.add(outage or nearest, stamp_ns, xyz_map_m, covariance_m2, velocity_map_mps, about_m)

    def heading(self, decided: bool) -> PriorHeading | None:
        """Heading at the newest LiDAR position, once; None: none, or not needed any more."""
        return self._same_frame.heading(decided)

    def contradicts(self, yaw_rad: float) -> bool:
        """Whether a yaw of the body that is decided at the newest LiDAR position is another one than before."""
        return self._same_frame.contradicts(yaw_rad)

    def odom_yaw(self, stamp_ns: int) -> OdomYaw | None:
        """Yaw of the autopilot's frame if the first LiDAR positions show that the frame is the same."""
        return self._same_frame.odom_yaw(stamp_ns)

    def restart_object(self) -> None:
        """LiDAR positions from now on may be those of another object."""
        self._same_frame.restart()

    def begin_outage(self, known_until_ns: int) -> None:
        """The vehicle's motion is not known after a time."""
        self._outage.begin(known_until_ns)
        self.forget_earlier_run()

    def start_frame(self, turn_rad: float) -> None:
        """A frame begins: the one before, maybe turned about the vehicle by up to an angle, or another."""
        self._same_frame = SameFrame(self._changed_frames, turn_rad)

    def forget(self) -> None:
        """Drop everything: it was contradicted, or lies in another frame."""
        self._outage.forget()
        self.forget_earlier_run()

    def forget_earlier_run(self) -> None:
        """`map` need not be that of an earlier run any more."""
        self._restart_priors.clear()
        self._of_earlier_run = False
