"""Evaluation of runs against truth (`grd evaluate`).

Data flow:

1. `text_files` (TUM, CSV) -> `run_data`: a run and its truth.
2. `association`: truth at the times of the outputs, drones to tracks.
3. `errors`: data frames of errors, and their statistics.
4. `metrics`: the catalogue; `pose_metrics`, `track_metrics` and `stage_metrics` fill an `evaluation` with its values.
5. `comparison` (medians, pairs of runs) and `groups` (by range, configuration, ...): many runs.
6. `tables` (terminal, CSV, JSON), `paper_tables`, `figures` and `report` (HTML).

This file imports nothing: `grd run` uses `association` without pandas and matplotlib.
"""
