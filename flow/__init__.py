"""The stage-graph engine: YAML in, checked graph, deterministic run. It knows nothing about drones."""

from flow.linear_algebra import use_portable_kernel

use_portable_kernel()  # before numpy is imported
