"""`grd run` live: start, stop, kill, and re-run from the recording."""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from flow.link import Record
from links.recording import Recorder, RecordingReader, recover
from links.runs.live_run import live_graph, run_live
from links.runs.request import RunRequest
from links.runs.run_folder import RunFolder
from tests import command

ROOT = Path(__file__).resolve().parents[3]
PATIENCE_S = 120.0
CONFIG = """\
stages:
  ticker: {use: tests.flow.live_toys.Ticker, inputs: {tick: clock.tick}}
  order: {use: tests.flow.live_toys.Order, inputs: {left: ticker.number, right: ticker.number}}
links:
  clock: {use: links.clock.Clock, config: {rate_hz: 100}}
  recorder: {use: links.recording.Recorder}
"""
FULL_DISK = """\
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
from links.cli import main
main()
"""


@pytest.fixture
def grd(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ticks.yaml").write_text(CONFIG)
    return command.grd


def test_a_live_run_writes_its_folder_and_is_repeated_to_the_same_hash(grd, tmp_path):
    text = grd("run", "ticks.yaml", "--for", 0.6, "--no-warm-up", "--hash")
    folder = tmp_path / "out" / "live-ticks"
    assert {path.name for path in folder.iterdir()} >= {"flight.mcap", "summary.json", "config.yaml", "run.log"}
    summary = json.loads((folder / "summary.json").read_text())
    assert f"output hash {summary['output_hash']}" in text
    assert summary["messages"]["ticker.number"] == summary["records"] > 1
    live = summary["live"]
    assert live["edges"]["ticker.tick"]["taken"] == summary["records"]
    assert live["edges"]["ticker.tick"]["source"] == "clock.tick"
    assert live["edges"]["ticker.tick"]["lag_max_ms"] > 0
    assert live["links"]["clock"]["openings"] == 1
    assert summary["counters"]["recorder"]["dropped"] == 0
    assert (live["dropped"], live["events"], live["switched_off"]) == (0, [], [])

    again = grd("replay", folder / "flight.mcap", "--as-live", "--trust")
    assert f"output hash {summary['output_hash']}" in again
    assert "the live run's hash is the same" in again
    repeated = json.loads((tmp_path / "out" / "flight-as-live" / "summary.json").read_text())
    assert repeated["messages"] == summary["messages"]

    plain = grd("replay", folder / "flight.mcap", "--config", "ticks.yaml")
    assert "wired to nothing" not in plain


def test_a_run_in_several_parts_is_repeated_and_replayed_as_a_whole(grd, tmp_path):
    (tmp_path / "split.yaml").write_text(CONFIG.replace("Recorder}", "Recorder, config: {split_s: 1}}"))
    grd("run", "split.yaml", "--for", 2.8, "--no-warm-up", "--hash")
    folder = tmp_path / "out" / "live-split"
    summary = json.loads((folder / "summary.json").read_text())
    parts = summary["counters"]["recorder"]["parts"]
    assert parts > 1
    again = grd("replay", folder / "flight.mcap", "--as-live", "--trust")
    assert f"in {parts} parts" in again
    assert "the live run's hash is the same" in again
    plain = grd("replay", folder / "flight.mcap", "--config", "ticks.yaml", "--out", "plain")
    assert f"in {parts} parts" in plain
    assert "warning" not in plain
    replayed = json.loads((tmp_path / "plain" / "summary.json").read_text())
    assert replayed["messages"]["ticker.number"] == summary["messages"]["ticker.number"] == summary["records"]


def test_a_live_recording_has_the_sender_with_the_channel(tmp_path):
    lidar = "  lidar: {use: links.lidar.Lidar, config: {port: 42368, sender: 127.0.0.9}}\n"
    (tmp_path / "lidar.yaml").write_text(CONFIG.replace("  recorder: {use: links.recording.Recorder}\n", lidar))
    asked = RunRequest(tmp_path / "lidar.yaml")
    run_folder = RunFolder(tmp_path / "run", tmp_path / "flight.mcap", asked, live_graph(asked), live=True)
    recorder = Recorder()
    run_folder.taps.append(recorder)
    with run_folder:
        for topic in ("/lidar/packets", "/servo/state"):
            recorder.record(Record(topic, 2, 1, b"any"))
    with RecordingReader(tmp_path / "run" / "flight.mcap") as reader:
        assert reader.channels == {"/lidar/packets": {"model": "VLP-16", "port": "42368", "sender": "127.0.0.9"}}


def test_a_repetition_that_differs_is_a_finding(grd, tmp_path, monkeypatch):
    grd("run", "ticks.yaml", "--for", 0.3, "--no-warm-up", "--hash")
    monkeypatch.setattr("tests.flow.live_toys.Order.finish", lambda self: None)  # another version of a stage
    text = grd("replay", tmp_path / "out" / "live-ticks" / "flight.mcap", "--as-live", "--trust", code=1)
    assert "the live run's hash is " in text
    assert "the same" not in text


def test_a_run_without_a_hash_is_repeated_without_comparison(grd, tmp_path):
    assert "output hash" not in grd("run", "ticks.yaml", "--for", 0.3, "--no-warm-up")
    text = grd("replay", tmp_path / "out" / "live-ticks" / "flight.mcap", "--as-live", "--trust")
    assert "the live run computed no hash to compare: record it with grd run --hash" in text
    assert "output hash" in text


def test_a_run_that_cannot_be_repeated_has_a_reason(grd):
    street = ROOT / "recordings" / "street_sweep.mcap"
    assert "is not the recording of a live run" in grd("replay", street, "--as-live", code=2).replace("\n", " ")
    text = grd("replay", street, "--as-live", "--set", "track.radius_m=2", code=2)
    assert "--as-live takes the recording's own configuration" in text


def test_a_stage_that_is_switched_off_is_a_finding_and_the_run_continues(grd, tmp_path):
    text = CONFIG.replace("Ticker, ", "Ticker, config: {raise_at: 1}, ")
    (tmp_path / "bad.yaml").write_text(text)
    output = grd("run", "bad.yaml", "--for", 0.6, "--no-warm-up", code=1)
    assert "ArithmeticError: requested at 1; ticker restarts" in output
    live = json.loads((tmp_path / "out" / "live-bad" / "summary.json").read_text())["live"]
    assert live["switched_off"] == ["ticker"]
    assert live["restarts"] == {"ticker": 5}
    assert "'ticker' was switched off after repeated errors" in output


def test_a_run_without_a_recorder_reports_that_nothing_is_recorded(grd, tmp_path):
    (tmp_path / "none.yaml").write_text(CONFIG.replace("  recorder: {use: links.recording.Recorder}\n", ""))
    output = grd("run", "none.yaml", "--for", 0.2, "--no-warm-up")
    assert "no links.recording.Recorder is configured: nothing is recorded" in output


def test_for_is_of_live_runs_only(grd):
    text = grd("run", ROOT / "configs" / "quickstart.yaml", "--for", 1, code=2)
    assert "--for is for live runs" in text


def start(folder: Path, config: str) -> tuple[subprocess.Popen[str], Path]:
    """A live run in a process of its own, and the mapped file with the newest record's arrival."""
    last = folder / "last_arrival"
    judge = f"  judge: {{use: tests.flow.live_toys.ArrivalTap, config: {{file: '{last}'}}}}\n"
    (folder / "ticks.yaml").write_text(config + judge)
    command = [sys.executable, "-c", "from links.cli import main; main()"]
    options = ["run", str(folder / "ticks.yaml"), "--out", str(folder / "run"), "--no-warm-up", "--hash"]
    child = subprocess.Popen(
        [*command, *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": "."},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    return child, last


def arrival_ns(last: Path) -> int:
    data = last.read_bytes() if last.exists() else b""
    return struct.unpack("<q", data)[0] if len(data) == 8 else 0


def wait_for_records(child: subprocess.Popen[str], last: Path, for_s: float) -> None:
    """Until so much time has passed between records; fails when the child ends."""
    first = 0
    while arrival_ns(last) < first + for_s * 1e9 or not first:
        first = first or arrival_ns(last)
        assert child.poll() is None, child.communicate()[0]
        threading.Event().wait(0.01)


def test_a_run_starts_and_continues_with_a_full_disk(tmp_path):
    """As after a restart in flight on a full disk; here no file may have a byte."""
    (tmp_path / "ticks.yaml").write_text(CONFIG)
    words = ["run", str(tmp_path / "ticks.yaml"), "--out", str(tmp_path / "run"), "--no-warm-up", "--for", "1"]
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": "."},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    output = (done.stdout + done.stderr).replace("\n", " ")
    assert done.returncode == 0, output
    assert "results are being lost" in output
    assert "nothing is recorded now, the run goes on" in output
    assert int(re.search(r"(\d+) records, [\d.]+ s recorded", output)[1]) > 10


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_run_in_order(tmp_path, number):
    child, last = start(tmp_path, CONFIG)
    wait_for_records(child, last, 0.3)
    child.send_signal(number)
    output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["output_hash"] in output
    with RecordingReader(tmp_path / "run" / "flight.mcap") as reader:
        assert reader.finished
        assert reader.topics["/clock"] == summary["records"]


def test_a_terminal_that_hangs_up_ends_no_run(tmp_path):
    """As an SSH connection that is lost in flight."""
    child, last = start(tmp_path, CONFIG)
    wait_for_records(child, last, 0.3)
    child.send_signal(signal.SIGHUP)
    wait_for_records(child, last, 0.6)
    assert child.poll() is None
    child.send_signal(signal.SIGTERM)
    output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0, output


def test_the_process_ends_within_two_seconds_of_ctrl_c(tmp_path):
    """Recording, summary and all. The promise is of time: on a machine that is too busy for it, the best of three."""
    took_s = []
    while len(took_s) < 3 and min(took_s, default=2.0) >= 2.0:
        folder = tmp_path / str(len(took_s))
        folder.mkdir()
        child, last = start(folder, CONFIG)
        wait_for_records(child, last, 0.3)
        began_s = time.monotonic()
        child.send_signal(signal.SIGINT)
        output, _ = child.communicate(timeout=PATIENCE_S)
        took_s.append(time.monotonic() - began_s)
        assert child.returncode == 0, output
    assert min(took_s) < 2.0, took_s


@pytest.mark.parametrize("status", [OSError(28, "No space left on device"), SystemExit(1)])
def test_a_blocked_terminal_ends_no_run(grd, tmp_path, status):
    """A log on a full disk, or a pipe whose reader has gone (rich ends the program then)."""

    def show(report):
        raise status

    asked = RunRequest(Path("ticks.yaml"), (), ())
    finished = run_live(tmp_path / "run", asked, live_graph(asked), show, 2.0)
    assert any("cannot write to the terminal (" in str(event) for event in finished.report.events)
    assert finished.report.records > 40
    assert "cannot write to the terminal" in (tmp_path / "run" / "run.log").read_text()


@pytest.mark.parametrize("after_s", [0.7, 1.3])
def test_a_run_killed_with_sigkill_loses_at_most_half_a_second_and_the_rest_can_be_repeated(tmp_path, grd, after_s):
    child, last = start(tmp_path, CONFIG)
    try:
        wait_for_records(child, last, after_s)
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    assert child.returncode == -signal.SIGKILL
    again = grd("run", "ticks.yaml", "--for", "0.2", "--out", tmp_path / "run", code=2)
    assert "has the recording of an interrupted run already (flight.mcap): name another --out, or move it" in again
    report = recover(tmp_path / "run" / "flight.mcap")
    with RecordingReader(report.path) as reader:
        ticks = list(reader.records(["/clock"]))
        orders = list(reader.records(["/run/order"]))
        assert "rate_hz: 100" in reader.config_yaml
    assert arrival_ns(last) - ticks[-1].arrival_ns <= 500_000_000
    assert orders
    assert not (tmp_path / "run" / "summary.json").exists()
    text = grd("replay", report.path, "--as-live", "--trust", "--out", tmp_path / "again")
    assert "the live run was interrupted, so its hash is not known" in text
    repeated = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert 0 < repeated["messages"]["order.number"] <= 2 * len(ticks)
