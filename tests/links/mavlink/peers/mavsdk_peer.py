"""Run by MAVSDK's Python: prints each message of the first detected system as one JSON line, until its input ends.

mavsdk_peer.py PORT MESSAGE...
"""

from __future__ import annotations

import json
import sys
import threading
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect

_lock = threading.Lock()


def write(**line: object) -> None:
    """Print one JSON line; MAVSDK calls back from its own thread."""
    with _lock:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def main() -> None:
    """Listen and print until the input ends."""
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    sdk.add_any_connection(f"udpin://127.0.0.1:{sys.argv[1]}")
    write(version=sdk.version())
    while not sdk.get_systems():
        time.sleep(0.05)
    system = sdk.get_systems()[0]
    direct = MavlinkDirect(system)
    for name in sys.argv[2:]:
        direct.subscribe_message(
            name, lambda m, _: write(name=m.message_name, sender=[m.system_id, m.component_id], fields=m.fields_json)
        )
    write(system=system.get_system_id(), components=system.component_ids())
    sys.stdin.read()
    sdk.destroy()


main()
