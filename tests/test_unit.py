"""deploy/grd.service: the properties that a crew relies on, and its two ways to start."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import time

import pytest

from tests.command import UNIT, unit_file

CHECK, RUN, RUN_AT_ONCE = (
    "check configs/field.yaml --overlay /etc/grd/vehicle.yaml",
    "run configs/field.yaml --overlay /etc/grd/vehicle.yaml",
    "run configs/field.yaml --overlay /etc/grd/vehicle.yaml --no-warm-up",
)


@pytest.fixture
def vehicle(tmp_path):
    """/opt/grd and /run/grd in a folder; a stand-in for grd prints its arguments."""
    grd = tmp_path / ".venv" / "bin" / "grd"
    grd.parent.mkdir(parents=True)
    grd.write_text('#!/bin/sh\necho "$@"\n')
    grd.chmod(0o755)
    (tmp_path / "run").mkdir()
    return tmp_path


def do(vehicle, setting: str) -> str:
    """Output of one of the unit's commands, with /run/grd in the folder."""
    command = shlex.split(unit_file()["Service"][setting].replace("/run/grd", str(vehicle / "run")))
    return subprocess.run(command, cwd=vehicle, check=True, capture_output=True, text=True).stdout.strip()


def start(vehicle) -> list[str]:
    return [output for setting in ("ExecStartPre", "ExecStart") if (output := do(vehicle, setting))]


def since(vehicle, ago_s: float) -> None:
    """Set the start of grd to this time before now."""
    then_s = time.time() - ago_s
    os.utime(vehicle / "run" / "since", (then_s, then_s))


def test_the_stop_signal_goes_to_grd_alone_so_that_it_ends_the_servo_in_order():
    service = unit_file()["Service"]
    assert service["KillMode"] == "mixed"
    assert service["KillSignal"] == "SIGTERM"
    assert "exec .venv/bin/grd run" in service["ExecStart"], "a shell in between would be the main process"
    assert float(service["TimeoutStopSec"]) >= 30, "a slow disk is waited for"


def test_it_wants_all_units_that_it_starts_after():
    unit = unit_file()["Unit"]
    assert set(unit["After"].split()) == {"network-online.target", "time-sync.target"}
    assert set(unit["Wants"].split()) == set(unit["After"].split())


def test_grd_is_restarted_after_every_failure():
    parts = unit_file()
    assert parts["Service"]["Restart"] == "on-failure"
    assert 0 < float(parts["Service"]["RestartSec"]) <= 1
    assert parts["Unit"]["StartLimitIntervalSec"] == "0"


def test_its_start_time_file_survives_a_restart():
    service = unit_file()["Service"]
    assert service["RuntimeDirectory"] == "grd"
    assert service["RuntimeDirectoryPreserve"] == "restart"


def test_a_first_start_is_checked_and_warmed_up(vehicle):
    assert start(vehicle) == [CHECK, RUN]


def test_after_a_crash_in_flight_it_restarts_without_checks(vehicle):
    start(vehicle)
    since(vehicle, 180.0)
    assert start(vehicle) == [RUN_AT_ONCE]
    assert start(vehicle) == [RUN_AT_ONCE]


def test_a_crash_soon_after_the_start_is_not_one_in_flight(vehicle):
    start(vehicle)
    since(vehicle, 50.0)
    note_s = (vehicle / "run" / "since").stat().st_mtime
    assert start(vehicle) == [CHECK, RUN]
    assert (vehicle / "run" / "since").stat().st_mtime == note_s, "crashes one after the other do not renew the note"


def test_after_a_stop_the_next_start_is_checked(vehicle):
    start(vehicle)
    since(vehicle, 180.0)
    do(vehicle, "ExecStop")
    assert start(vehicle) == [CHECK, RUN]


def test_an_invalid_configuration_stops_the_start(vehicle):
    (vehicle / ".venv" / "bin" / "grd").write_text("#!/bin/sh\nexit 2\n")
    with pytest.raises(subprocess.CalledProcessError) as error:
        do(vehicle, "ExecStartPre")
    assert error.value.returncode == 2
    assert not (vehicle / "run" / "since").exists()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze")
def test_systemd_accepts_it():
    result = subprocess.run(["systemd-analyze", "verify", str(UNIT)], capture_output=True, text=True, check=False)
    assert "grd.service" not in result.stderr, result.stderr
    assert result.returncode == 0, result.stderr
