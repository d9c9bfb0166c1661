"""The installed viewer draws runs off-screen, without an error in any view."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import synthetic
import synthetic_vision
from rerun.chunk import RrdReader

from flow.link import LinkError, Run
from links.viewer import Viewer, ViewerMissing, screenshot, show


def record(folder: Path, seconds: float, *, only: str = "", mount=synthetic.MOUNT, evidence: bool = False) -> Path:
    viewer = Viewer(lossless=True, mount=mount)
    mermaid = synthetic.EVIDENCE_MERMAID if evidence else synthetic.MERMAID
    viewer.open(Run(out_dir=folder, name="test", mermaid=mermaid, settings_yaml=synthetic.SETTINGS))
    for output, content in (synthetic.run_by_evidence if evidence else synthetic.run)(seconds):
        if output.startswith(only):
            viewer.see(output, content, 0)
    viewer.close()
    assert viewer.errors == {}
    return folder / "run.rrd"


def view_errors(rrd: Path, png: Path) -> list[str]:
    try:
        return screenshot(rrd, png, size="960x540", wait_s=0.5)
    except ViewerMissing as error:
        pytest.skip(str(error))


def size_of(png: Path) -> tuple[int, int]:
    head = png.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(head[16:20]), int.from_bytes(head[20:24])


def test_a_run_is_drawn_without_an_error_of_any_view(tmp_path):
    png = tmp_path / "run.png"
    assert view_errors(record(tmp_path, 3.0), png) == []
    assert size_of(png) == (960, 540)
    assert png.stat().st_size > 150_000  # a layout without data has a third of it


def test_a_run_with_candidates_and_two_drones_one_lost_is_drawn(tmp_path):
    png = tmp_path / "run.png"
    assert view_errors(record(tmp_path, 2.2, evidence=True), png) == []
    assert png.stat().st_size > 100_000


def test_a_run_with_two_cameras_is_drawn(tmp_path):
    viewer = Viewer(lossless=True, mount=synthetic.MOUNT, cameras=synthetic_vision.CAMERAS)
    viewer.open(Run(out_dir=tmp_path, name="test", mermaid=synthetic_vision.MERMAID, settings_yaml=""))
    for output, content in synthetic_vision.run(1.2):
        viewer.see(output, content, 0)
    viewer.close()
    assert viewer.errors == {}
    assert view_errors(tmp_path / "run.rrd", tmp_path / "run.png") == []


def test_a_run_of_the_lidar_alone_without_mount_is_drawn(tmp_path):
    assert view_errors(record(tmp_path, 0.5, only="lidar", mount=None), tmp_path / "run.png") == []


def test_a_damaged_file_is_reported_by_name_without_a_hang(tmp_path):
    damaged = tmp_path / "damaged.rrd"
    damaged.write_bytes(b"no rerun recording" * 100)
    with pytest.raises(LinkError, match=r"damaged\.rrd: the viewer cannot load it"):
        view_errors(damaged, tmp_path / "x.png")


def test_a_truncated_run_is_recovered_by_the_command_in_the_error(tmp_path):
    rrd = record(tmp_path, 0.5)
    rrd.write_bytes(rrd.read_bytes()[: rrd.stat().st_size // 2])
    with pytest.raises(LinkError, match=r"rerun rrd merge .*run\.rrd -o recovered\.rrd"):
        view_errors(rrd, tmp_path / "x.png")
    recovered = tmp_path / "recovered.rrd"
    subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "merge", rrd, "-o", recovered], check=True, capture_output=True
    )
    paths = {chunk.entity_path for chunk in RrdReader(recovered).stream().to_chunks()}
    assert "/frames/turntable" in paths


@pytest.mark.skipif("DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ, reason="would open a window")
def test_without_a_display_the_error_suggests_a_screenshot(tmp_path):
    with pytest.raises(ViewerMissing, match="--screenshot"):
        show(record(tmp_path, 0.1))


def test_a_missing_file_is_reported_before_the_viewer_starts(tmp_path):
    with pytest.raises(LinkError, match="no such file"):
        screenshot(tmp_path / "none.rrd", tmp_path / "x.png")
