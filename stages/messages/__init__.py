"""All messages between stages, by module in the order of data flow. Frames: see `stages/geometry/frames.py`.

    sensors -> sweep -> drone;  sensors -> cameras;  cues;  autopilot;  all of them -> pose

`stamp_ns` is the time at which a message's content was true, not its arrival. None of them contains ground truth.

Source: DESIGN, the graph.
"""

from stages.messages.autopilot import AutopilotEstimator as AutopilotEstimator
from stages.messages.autopilot import AutopilotStatus as AutopilotStatus
from stages.messages.autopilot import DroneAttitude as DroneAttitude
from stages.messages.autopilot import DroneImu as DroneImu
from stages.messages.autopilot import DroneLocalPosition as DroneLocalPosition
from stages.messages.autopilot import DroneOdometry as DroneOdometry
from stages.messages.autopilot import DroneTilt as DroneTilt
from stages.messages.autopilot import EarlierOdomFrame as EarlierOdomFrame
from stages.messages.autopilot import HeadingPrior as HeadingPrior
from stages.messages.cameras import BranchState as BranchState
from stages.messages.cameras import CameraMount as CameraMount
from stages.messages.cameras import FollowedFeatures as FollowedFeatures
from stages.messages.cameras import RelativeRotation as RelativeRotation
from stages.messages.cameras import VanishingDirections as VanishingDirections
from stages.messages.cameras import VisualMotion as VisualMotion
from stages.messages.cameras import WeightedAnswers as WeightedAnswers
from stages.messages.cues import CueFactor as CueFactor
from stages.messages.cues import CueKind as CueKind
from stages.messages.cues import CueState as CueState
from stages.messages.cues import DroneCue as DroneCue
from stages.messages.cues import DroneGlobalPosition as DroneGlobalPosition
from stages.messages.cues import DroneGnss as DroneGnss
from stages.messages.cues import UwbRange as UwbRange
from stages.messages.cues import VehicleGnss as VehicleGnss
from stages.messages.drone import AutopilotMotion as AutopilotMotion
from stages.messages.drone import CandidateEvidence as CandidateEvidence
from stages.messages.drone import CandidateLog as CandidateLog
from stages.messages.drone import Candidates as Candidates
from stages.messages.drone import Detections as Detections
from stages.messages.drone import DroneFix as DroneFix
from stages.messages.drone import DroneMotion as DroneMotion
from stages.messages.drone import GyroBias as GyroBias
from stages.messages.drone import KernelScores as KernelScores
from stages.messages.drone import MeanShiftResult as MeanShiftResult
from stages.messages.drone import SearchResult as SearchResult
from stages.messages.drone import TrackingState as TrackingState
from stages.messages.drone import TrackState as TrackState
from stages.messages.heading import HeadingEstimate as HeadingEstimate
from stages.messages.pose import PoseEstimate as PoseEstimate
from stages.messages.pose import PoseState as PoseState
from stages.messages.pose import PositionEstimate as PositionEstimate
from stages.messages.pose import RelativePose as RelativePose
from stages.messages.sensors import Image as Image
from stages.messages.sensors import LidarFirings as LidarFirings
from stages.messages.sensors import MotionStatus as MotionStatus
from stages.messages.sensors import ServoGoal as ServoGoal
from stages.messages.sensors import ServoOffset as ServoOffset
from stages.messages.sensors import ServoState as ServoState
from stages.messages.sensors import Tick as Tick
from stages.messages.sensors import VehicleMotion as VehicleMotion
from stages.messages.sweep import DepthImage as DepthImage
from stages.messages.sweep import ScoreImage as ScoreImage
from stages.messages.sweep import SweptPoints as SweptPoints
from stages.messages.sweep import SweptPulses as SweptPulses
