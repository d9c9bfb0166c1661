"""Writes the points of an Ouster capture by ouster-sdk, in the lidar frame. Runs in an environment of its own.

    python ouster_sdk_points.py CAPTURE.pcap METADATA.json OUT.npz

xyz_m (n, 3): every non-empty return of every valid column.
"""

import sys

import numpy as np
from ouster.sdk import open_source

try:
    from ouster.sdk.core import ChanField, XYZLut
except ModuleNotFoundError:
    from ouster.sdk.client import ChanField, XYZLut

capture, metadata, target = sys.argv[1:]
source = open_source(capture, meta=[metadata])
info = source.sensor_info[0] if hasattr(source, "sensor_info") else source.metadata
transform = np.array(info.lidar_to_sensor_transform)
points = []
for frames in source:
    frame = frames if hasattr(frames, "status") else frames[0]  # newer versions: those of all sensors
    for field in (ChanField.RANGE, ChanField.RANGE2):
        if field not in frame.fields:
            continue
        range_mm, xyz_m = frame.field(field), XYZLut(info, False)(frame.field(field))
        seen = (range_mm > 0) & (frame.status & 1).astype(bool)[None, :]
        points.append((xyz_m[seen] - 1e-3 * transform[:3, 3]) @ transform[:3, :3])
np.savez(target, xyz_m=np.concatenate(points))
