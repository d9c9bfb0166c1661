"""Writes the points of an Ouster capture by ouster-sdk, in the lidar frame. Runs in an environment of its own.

    python ouster_sdk_points.py CAPTURE.pcap METADATA.json OUT.npz

xyz_m (n, 3): every non-empty return of every valid column.
"""

import sys

import numpy as np
from ouster.sdk import open_source
from ouster.sdk.client import ChanField, XYZLut

capture, metadata, target = sys.argv[1:]
source = open_source(capture, meta=[metadata])
info = source.metadata
transform = np.array(info.lidar_to_sensor_transform)
points = []
for scan in source:
    for field in (ChanField.RANGE, ChanField.RANGE2):
        if field not in scan.fields:
            continue
        range_mm, xyz_m = scan.field(field), XYZLut(info, False)(scan.field(field))
        seen = (range_mm > 0) & (scan.status & 1).astype(bool)[None, :]
        points.append((xyz_m[seen] - 1e-3 * transform[:3, 3]) @ transform[:3, :3])
np.savez(target, xyz_m=np.concatenate(points))
