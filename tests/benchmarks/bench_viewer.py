"""Cost of the viewer for the run: `see`, compared with drawing in the caller's thread, and thinning of a slice.

Run: python -m pytest tests/benchmarks/bench_viewer.py --benchmark-only
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from flow.link import Run
from links.viewer import Viewer
from links.viewer.draw import draw
from links.viewer.message_queue import Slicer, thin
from links.viewer.scene import ViewerScene
from links.viewer.stream import Stream

sys.path.append(str(Path(__file__).parents[1] / "links" / "viewer"))
import synthetic

RUNS = {"paper": list(synthetic.run(1.0)), "evidence": list(synthetic.run_by_evidence(1.0))}


@pytest.fixture
def viewer(tmp_path):
    """A viewer that neither drops nor blocks within a benchmark."""
    tap = Viewer(queue_size=10_000_000)
    tap.open(Run(out_dir=tmp_path, name="bench", mermaid="", settings_yaml=""))
    yield tap
    tap.close()


@pytest.mark.parametrize("run", RUNS)
def test_see_a_second_of_messages(benchmark, viewer, run):
    def see_all():
        for output, content in RUNS[run]:
            viewer.see(output, content, 0)

    benchmark.pedantic(see_all, rounds=20)
    if benchmark.stats is not None:  # None with --benchmark-disable
        benchmark.extra_info["us_per_message"] = round(benchmark.stats.stats.median / len(RUNS[run]) * 1e6, 2)


class RowByRow(Stream):
    """Writes each number of a curve as it arrives."""

    def put(self, entity, *, static=False):
        super().put(entity, static=static)
        self._write_curves()


@pytest.mark.parametrize(
    ("slice_s", "kind"), [(0.1, Stream), (0.1, RowByRow), (1e-6, Stream)], ids=["slices", "rows", "packets"]
)
@pytest.mark.parametrize("run", RUNS)
def test_draw_a_second_of_messages_in_the_caller(benchmark, tmp_path, run, slice_s, kind):
    """Compares the viewer's batches with writing each number of a curve and drawing each packet on its own."""
    stream = kind(tmp_path / "bench.rrd", None, "256MiB", Counter(), rrb.Blueprint())

    def draw_all():
        scene = ViewerScene(mount=synthetic.MOUNT, history_s=3.0, slice_s=0.1, max_points=6000, trail_s=20.0)
        slicer = Slicer(slice_s)
        for output, content in RUNS[run]:
            for name, stamp_ns, ready in slicer.add(output, content):
                stream.at(stamp_ns)
                for entity in draw(ready, name.replace(".", "/"), scene):
                    stream.put(entity)

    benchmark.pedantic(draw_all, rounds=2)
    if benchmark.stats is not None:  # None with --benchmark-disable
        benchmark.extra_info["us_per_message"] = round(benchmark.stats.stats.median / len(RUNS[run]) * 1e6, 2)


def test_thin_a_slice(benchmark):
    points = np.random.default_rng(0).uniform(-30, 30, (15_000, 3)).astype(np.float32)
    benchmark(thin, points, 6000)
