"""Progress on stderr, and the line while a command loads."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from links.cli import app, console
from tests.command import grd


@pytest.fixture
def stderr(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=stream, force_terminal=False, soft_wrap=True))
    return stream


def test_a_slow_step_prints_lines_in_a_log(stderr, monkeypatch):
    monkeypatch.setattr(console, "BAR_DELAY_S", 0.0)
    monkeypatch.setattr(console, "LINE_PERIOD_S", 0.02)
    with console.progress_bar("replay x.mcap") as step:
        time.sleep(0.2)
        step(1.0, 4.0)
        time.sleep(0.2)
    lines = stderr.getvalue().splitlines()
    assert lines[0] == "replay x.mcap: 0 s"
    assert lines[-1] == "replay x.mcap: 0 s, 25 %"


def test_a_fast_step_prints_nothing_unless_it_is_asked_to(stderr):
    with console.progress_bar("replay x.mcap") as step:
        step(1.0, 2.0)
    assert stderr.getvalue() == ""
    with console.progress_bar("replay x.mcap", at_once=True):
        time.sleep(0.1)
    assert stderr.getvalue() == "replay x.mcap: 0 s\n"


def test_a_terminal_shows_a_bar_while_one_step_takes_long(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(console, "err", Console(file=stream, force_terminal=True, width=80))
    monkeypatch.setattr(console, "BAR_DELAY_S", 0.0)
    with console.progress_bar("replay x.mcap"):
        time.sleep(0.3)
    assert "replay x.mcap" in stream.getvalue()


@pytest.mark.parametrize(("environment", "lines"), [({}, 1), ({"_GRD_COMPLETE": "complete_bash"}, 0)])
def test_a_slow_import_prints_a_line_but_not_for_completions(capsys, monkeypatch, environment, lines):
    monkeypatch.setattr(app, "LOADING_LINE_AFTER_S", 0.0)
    monkeypatch.setattr(app, "import_module", lambda _: time.sleep(0.2) or console)
    monkeypatch.setitem(app.COMMANDS, "slow", ("console:warn", ""))
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    app.command("slow")
    assert capsys.readouterr().err.count("a first run also compiles") == lines


def test_a_mistyped_command_names_a_similar_one():
    assert "No such command 'repaly'. Did you mean 'replay'?" in grd("repaly", code=2)
    assert "Did you mean" not in grd("xyzzy", code=2)
