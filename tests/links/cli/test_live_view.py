"""Console display of a live run, on a terminal and in a log."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from flow.config.edge import Edge, QueueSettings
from flow.counters import Counters
from flow.live.report import EdgeCount, LinkReport, LinkState, LiveReport, edge_report
from flow.taps import Digest
from links.cli.live_view import LiveView, Rates
from links.runs.live_run import RunStatus
from stages.messages import (
    DroneFix,
    Image,
    PoseEstimate,
    PoseState,
    RelativePose,
    SweptPulses,
    TrackingState,
    TrackState,
)


def report_of(lags_ms=(3.0, 150.0), dropped=2, state=LinkState.OPEN, reason="", off=()):
    count = EdgeCount(Edge("sweep", "swept_pulses", "track", "pulses", SweptPulses, QueueSettings("drop_oldest", 64)))
    for lag_ms in lags_ms:
        count.done(round(lag_ms * 1e6))
    return LiveReport(
        records=1234,
        edges={"track.pulses": edge_report(count, dropped)},
        links={"lidar": LinkReport(state, 1200, 1, reason=reason)},
        counters={
            "lidar": Counters({"lost": 7, "from other senders": 0}),
            "fuse": Counters({"back end reset": 0}, {"fix: not finite": 3}),
            "recorder": Counters({"missed": 0}),
        },
        switched_off=list(off),
    )


def pose(state=PoseState.FULL, **changes):
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    values = {
        "stamp_ns": 1,
        "state": state,
        "reason": "seen now",
        "measured_ns": 1,
        "track_id": 1,
        "resets": 0,
        "nis": 1.0,
        "estimate": PoseEstimate(
            xyz_vehicle_m=np.array([1.0, -2.0, 10.0]),
            R_vehicle_drone=quarter,
            covariance=np.diag([1.0, 1.0, 1.0, 0.01, 0.02, 0.06]),
            velocity_vehicle_mps=np.zeros(3),
            xyz_map_m=np.zeros(3),
            R_map_drone=np.eye(3),
            map_covariance=np.eye(6),
            velocity_map_mps=np.zeros(3),
            velocity_covariance=np.eye(3),
        ),
    }
    return RelativePose(**(values | changes))


def shown(report, *messages, terminal=False, news=(), used="", **by_output):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=160, highlight=False, soft_wrap=True)
    with LiveView(console) as view:
        for message in messages:
            view.latest.see("x", message, 0)
        for output, message in by_output.items():
            view.latest.see(output, message, 0)
        view.show(RunStatus(12.34, lambda: report, list(news), used))
    return stream.getvalue()


def test_a_log_has_one_line_with_state_pose_lag_and_losses():
    line = shown(report_of(), pose())
    assert line == (
        "12.3 s; FULL: seen now; x 1.00  y -2.00  z 10.00 m  sigma 0.30 m  yaw 90.0 deg; "
        "1234 records, worst lag p99 150.0 ms, 2 dropped, 1 late\n"
    )


def test_without_a_fused_pose_the_track_and_its_last_fix_are_shown():
    track = TrackState(stamp_ns=1, state=TrackingState.TRACKING, reason="5 returns", hits=5, frame_s=0.1)
    fix = DroneFix(
        stamp_ns=1,
        xyz_vehicle_m=np.array([3.0, 4.0, 5.0]),
        covariance_m2=0.03 * np.eye(3),
        hits=5,
    )
    assert "TRACKING: 5 returns; x 3.00  y 4.00  z 5.00 m  sigma 0.30 m; " in shown(report_of(), track, fix)
    assert "no drone yet; 1234 records" in shown(report_of())


def test_each_of_two_drones_has_its_state_its_pose_and_its_autopilot():
    report = report_of()
    for name, sent in (("autopilot", 70), ("autopilot_2", 30)):
        report.counters[name] = Counters(groups={"pose rejected": {"no yaw": 12}, "sent": {"ODOMETRY": sent}})
    two = {"fuse_2.relative_pose": pose(PoseState.LOST, estimate=None), "fuse.relative_pose": pose()}
    log, screen = shown(report, **two), shown(report, terminal=True, **two)
    assert "12.3 s; fuse FULL: seen now; x 1.00  y -2.00" in log
    assert "; fuse_2 LOST: seen now; 1234 records" in log
    for words in ("fuse FULL: seen now", "fuse_2 LOST: seen now", "no position"):
        assert words in screen
    assert "to autopilot: ODOMETRY 70; held back: no yaw 12" in screen
    assert "to autopilot_2: ODOMETRY 30; held back: no yaw 12" in screen


def test_each_of_two_tracks_has_its_own_fix():
    track = TrackState(stamp_ns=1, state=TrackingState.TRACKING, reason="5 returns", hits=5, frame_s=0.1)
    fixes = [
        DroneFix(stamp_ns=1, xyz_vehicle_m=np.array([x, 0.0, 5.0]), covariance_m2=np.eye(3), hits=5) for x in (1.0, 2.0)
    ]
    outputs = {"track.track_state": track, "track.drone_fix": fixes[0], "track_2.drone_fix": fixes[1]}
    line = shown(report_of(), **outputs)
    assert "track TRACKING: 5 returns; x 1.00" in line
    assert "track_2 no drone yet; x 2.00" in line


def test_a_lost_pose_has_no_numbers():
    assert "LOST: seen now; 1234 records" in shown(report_of(), pose(PoseState.LOST, estimate=None))


def test_a_link_that_is_not_open_and_a_stage_that_is_off_are_in_the_line():
    line = shown(report_of(state=LinkState.FAILED, reason="no packet on UDP 2368 for 2 s", off=["vp_drone"]))
    assert "OFF: vp_drone; lidar no packet on UDP 2368 for 2 s\n" in line


def test_news_are_printed_at_once_between_two_lines(capsys):
    stream = io.StringIO()
    with LiveView(Console(file=stream, width=160, soft_wrap=True)) as view:
        view.show(RunStatus(0.0, report_of, ["lidar: first"]))
        view.show(RunStatus(0.1, report_of, ["lidar: second"]))
    assert stream.getvalue().count("\n") == 1
    assert capsys.readouterr().err == "lidar: first\nlidar: second\n"


def test_a_terminal_shows_state_sources_the_bad_edges_and_the_newest_events():
    text = shown(report_of(), pose(), terminal=True, news=["servo: stalled"], used="512 MB of memory, 41 GB free")
    for words in ("track.pulses", "sweep.swept_pulses", "150.0", "lost 7", "FULL: seen now", "12.3 s  servo: stalled"):
        assert words in text
    assert "late\n             512 MB of memory, 41 GB free" in text
    assert "fuse: rejected: fix: not finite 3" in text
    for nothing in ("recorder", "back end reset"):
        assert nothing not in text
    assert "from other senders" not in text, "counts of zero are left out"


def test_edges_without_losses_are_not_shown():
    text = shown(report_of(lags_ms=(3.0,), dropped=0), pose(), terminal=True)
    assert "track.pulses" not in text
    assert "lag [ms]" not in text


def test_a_source_has_its_rate_the_age_of_its_newest_record_and_its_status():
    rates = Rates()
    for now_s, count in ((10.0, 0), (10.5, 100), (12.0, 200), (12.5, 200)):
        rates.add(now_s, {"lidar": count})
    assert rates.texts(12.5, "lidar") == ("100.0", "0.5")
    assert rates.texts(12.5, "servo") == ("", "")
    report = report_of()
    report.statuses = {"lidar": "its clock has jumped", "recorder": "the disk is full"}
    text = shown(report, terminal=True)
    assert "its clock has jumped  lost 7" in text
    assert "the disk is full" in text


def test_what_is_sent_to_the_autopilot_and_what_is_held_back_is_shown():
    report = report_of()
    assert "autopilot" not in shown(report, terminal=True)
    report.counters["autopilot"] = Counters(groups={"pose rejected": {"no yaw": 12}, "sent": {"HEARTBEAT": 9}})
    assert "to the autopilot: nothing sent; held back: no yaw 12" in shown(report, terminal=True)
    report.counters["autopilot"] = Counters(groups={"pose rejected": {"no yaw": 12}, "sent": {"ODOMETRY": 70}})
    assert "to the autopilot: ODOMETRY 70; held back: no yaw 12" in shown(report, terminal=True)


def test_the_screen_of_a_bad_day_fits_24_rows_of_80_columns():
    report = report_of()
    for n in range(9):
        report.links[f"source_{n}"] = LinkReport(LinkState.FAILED, 0, 1, reason="no packet on UDP 2368: " + "x" * 200)
        report.edges[f"stage_{n}.input"] = report.edges["track.pulses"]
        report.counters[f"stage_{n}"] = Counters({}, {"y" * 200: 3})
    report.counters["autopilot"] = Counters(groups={"pose rejected": {"no yaw": 12}, "sent": {"ODOMETRY": 70}})
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=80, highlight=False, soft_wrap=True)
    with LiveView(console) as view:
        view.latest.see("x", pose(), 0)
        screen = view._table(RunStatus(12.3, lambda: report, [], "512 MB"), 0.0)
        for n in range(9):
            view._events.append(f"event {n} {'z' * 200}")
        screen = view._table(RunStatus(12.3, lambda: report, [], "512 MB"), 0.0)
    rows = console.render_lines(screen, console.options.update(width=80))
    assert len(rows) <= 24


@pytest.mark.parametrize(("kind", "wanted"), [(RelativePose, True), (DroneFix, True), (Image, False)])
def test_the_view_receives_only_the_messages_that_it_shows(kind, wanted):
    assert LiveView().latest.wants(kind) is wanted
    assert Digest().wants(kind)
