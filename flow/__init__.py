"""The stage-graph engine: YAML in, checked graph, deterministic run. It knows nothing about drones."""
