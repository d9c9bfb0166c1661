"""Secrets in settings never reach a file of the run, its recording or the viewer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flow.config.secrets import without_secrets
from flow.config_error import ConfigError
from flow.graph import load_graph
from links.recording import RecordingReader
from tests import command

PASSWORD = "hunter2"
CONFIG = f"""\
stages:
  order: {{use: tests.flow.live_toys.Ticker, inputs: {{tick: clock.tick}}}}
links:
  clock: {{use: links.clock.Clock, config: {{rate_hz: 50}}}}
  camera:
    use: links.camera.Camera
    config: {{topic: /camera/vehicle, source: "rtsp://crew:{PASSWORD}@127.0.0.1:9/live?token={PASSWORD}&fps=30"}}
  recorder: {{use: links.recording.Recorder}}
  viewer: {{use: links.viewer.Viewer}}
"""


@pytest.mark.parametrize(
    ("text", "stored"),
    [
        ("rtsp://crew:pass@192.168.1.9/live", "rtsp://***@192.168.1.9/live"),
        ("rtsp://crew:pa/ss@w@192.168.1.9/live", "rtsp://***@192.168.1.9/live"),
        ("http://10.0.0.1/video?user=a&password=b&size=2", "http://10.0.0.1/video?user=a&password=***&size=2"),
        ("http://10.0.0.1/video?access_token=abc", "http://10.0.0.1/video?access_token=***"),
        ("camera.source='rtsp://a:b@c/d'", "camera.source='rtsp://***@c/d'"),
        ("/dev/video0", "/dev/video0"),
        ("udpin:127.0.0.1:14550", "udpin:127.0.0.1:14550"),
        ("rtsp://192.168.1.9/live", "rtsp://192.168.1.9/live"),
    ],
)
def test_the_secrets_of_a_url_are_replaced_and_nothing_else(text, stored):
    assert without_secrets(text) == stored


def test_the_graph_itself_keeps_the_password_it_needs(tmp_path):
    (tmp_path / "x.yaml").write_text(CONFIG)
    graph = load_graph(tmp_path / "x.yaml")
    assert PASSWORD in graph.nodes["camera"].config["source"]
    assert PASSWORD not in graph.settings_yaml()


@pytest.mark.parametrize("setting", ["camera.sourc=rtsp://crew:{}@host/x", "camera.source=[rtsp://crew:{}@host/x]"])
def test_an_error_in_the_configuration_does_not_show_the_password(tmp_path, setting):
    (tmp_path / "x.yaml").write_text(CONFIG)
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "x.yaml", sets=[setting.format(PASSWORD)])
    assert PASSWORD not in str(caught.value)
    assert "rtsp://***@host/x" in str(caught.value)


def test_no_file_of_a_live_run_holds_the_camera_s_password(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("secret.yaml").write_text(CONFIG)
    source = f"camera.source=rtsp://crew:{PASSWORD}@127.0.0.1:9/other"
    printed = command.grd("run", "secret.yaml", "--for", 1.5, "--no-warm-up", "--set", source, "--out", "out", code=1)
    assert PASSWORD not in printed
    assert json.loads(Path("out/summary.json").read_text())["set"] == ["camera.source=rtsp://***@127.0.0.1:9/other"]
    with RecordingReader("out/flight.mcap") as reader:
        assert "rtsp://***@127.0.0.1:9/other" in (reader.config_yaml or "")
    files = [file for file in Path("out").iterdir() if file.is_file()]
    assert {"config.yaml", "flight.mcap", "run.rrd", "run.log", "summary.json"} <= {file.name for file in files}
    assert not [file.name for file in files if PASSWORD.encode() in file.read_bytes()]
