"""Attacks by a recording from someone else: its configuration and its rig are data, and harm nothing outside the run."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
import yaml

from flow.config_error import ConfigError
from flow.link import LinkError
from flow.live.input_order import OrderLog
from links.recording import RecordingWriter
from links.runs.as_live import rerun_into
from links.runs.request import RunRequest
from links.runs.run_folder import replay_into

ROOT = Path(__file__).resolve().parents[3]
RIG = yaml.safe_load((ROOT / "configs" / "rigs" / "standard.yaml").read_text())["rig"]
SWEEP = {
    "use": "stages.sweep.Sweep",
    "config": {"mount": "$rig.lidar.mount"},
    "inputs": {"firings": "lidar.lidar_firings"},
}
LIDAR = {"use": "links.lidar.Lidar"}
MAX_S = 20.0  # of processor time, for one attack


def recording(folder: Path, config: dict | str, rig: str | None = None) -> Path:
    """A recording of a live run with this configuration, in which `sweep` took one message."""
    order = OrderLog("sweep", ["firings"])
    order.add(0, 0)
    record = order.take(1)
    assert record is not None
    path = folder / "flight.mcap"
    text = config if isinstance(config, str) else yaml.safe_dump(config)
    with RecordingWriter(path, rig_yaml=rig, config_yaml=text, lossless=True, overwrite=True) as writer:
        writer.write(record)
    return path


def configuration(**links: dict) -> dict:
    return {"rig": RIG, "stages": {"sweep": SWEEP}, "links": {"lidar": LIDAR, **links}}


def viewer(**settings) -> dict:
    return {"use": "links.viewer.Viewer", "config": settings}


def test_a_harmless_recording_is_repeated_with_its_viewer(tmp_path):
    rerun_into(tmp_path / "out", recording(tmp_path, configuration(viewer=viewer(file="run.rrd"))))
    assert (tmp_path / "out" / "run.rrd").stat().st_size > 100


@pytest.mark.parametrize("path", ["../victim.rrd", "{folder}/victim.rrd", "../victim"])
def test_a_recording_overwrites_no_file_outside_the_run(tmp_path, path):
    victim = tmp_path / ("victim.rrd" if path.endswith("rrd") else "victim")
    victim.write_text("precious")
    attack = recording(tmp_path, configuration(viewer=viewer(file=path.format(folder=tmp_path))))
    with pytest.raises(ConfigError, match=r"links\.viewer\.config\.file"):
        rerun_into(tmp_path / "out", attack)
    assert victim.read_text() == "precious"


def test_a_recording_opens_no_server(tmp_path, monkeypatch):
    served: list[int] = []
    sink = "links.viewer.stream.rr.GrpcServerSink"
    monkeypatch.setattr(sink, lambda host, port, **_: served.append(port) or pytest.fail("a server was opened"))
    rerun_into(tmp_path / "out", recording(tmp_path, configuration(viewer=viewer(serve=True, port=29876))))
    assert served == []


def test_a_recording_imports_no_module_outside_grd(tmp_path, monkeypatch):
    (tmp_path / "intruder.py").write_text(
        f"open({str(tmp_path / 'intruded')!r}, 'w').close()\n"
        "from stages.sweep import Sweep\n"  # a name that a static check finds
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    config = configuration()
    config["stages"]["sweep"] = {**SWEEP, "use": "intruder.Sweep"}
    with pytest.raises(ConfigError, match=r"'intruder\.Sweep' is not of grd"):
        rerun_into(tmp_path / "out", recording(tmp_path, config))
    assert not (tmp_path / "intruded").exists()
    sys.modules.pop("intruder", None)


def test_one_s_own_recording_may_import_one_s_own_stages(tmp_path, monkeypatch):
    (tmp_path / "own_stages.py").write_text("from stages.sweep import Sweep\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    config = configuration()
    config["stages"]["sweep"] = {**SWEEP, "use": "own_stages.Sweep"}
    rerun_into(tmp_path / "out", recording(tmp_path, config), trusted=True)


def test_a_recording_reads_no_other_file(tmp_path):
    secret = tmp_path / "secret.yaml"
    secret.write_text("links: {x: {use: a.b, config: {password: hunter2}}}\n")
    for key in ("include", "replay"):
        with pytest.raises((LinkError, ConfigError)) as caught:
            rerun_into(tmp_path / "out", recording(tmp_path, {**configuration(), key: str(secret)}))
        assert f"'{key}' is not read from a recording" in str(caught.value)
        assert not (tmp_path / "out").exists()


def test_of_the_taps_in_a_recording_only_the_viewer_runs(tmp_path, monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr("links.recording.Recorder.open", lambda self, run: opened.append(run.name))
    links = {"recorder": {"use": "links.recording.Recorder"}}
    rerun_into(tmp_path / "out", recording(tmp_path, configuration(**links)))
    assert opened == []


BOMB = "a: &a [0,0,0,0,0,0,0,0,0]\n" + "".join(
    f"{name}: &{name} {{{', '.join(f'k{i}: *{below}' for i in range(9))}}}\n"
    for below, name in zip("abcde", "bcdef", strict=True)
)
REFERENCES = "lidar: {mount: $rig.r5}\nr0: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n" + "".join(
    f"r{n}: [{', '.join([f'$rig.r{n - 1}'] * 9)}]\n" for n in range(1, 6)
)
CHAIN = "lidar: {mount: $rig.c0}\n" + "".join(f"c{n}: $rig.c{n + 1}\n" for n in range(2000)) + "c2000: 1\n"
RIGS = {
    "a bomb of aliases": (BOMB, "too large"),
    "a bomb of references": (REFERENCES, "references expand to more than"),
    "a chain of references": (CHAIN, "refers through more than"),
    "an alias within itself": ("lidar: &a {mount: *a}", "too deep"),
    "deep brackets": ("[" * 5000, "is not YAML"),
    "a tag that does not fit": ("lidar: !!bool 7", "cannot be read"),
    "a date that is none": ("lidar: !!timestamp x", "cannot be read"),
    "an empty number": ('lidar: !!int ""', "cannot be read"),
    "a key that is a list": ("? [a]\n: 1", "a key must be a plain word"),
    "a key that is a mapping": ("? {a: 1}\n: 1", "a key must be a plain word"),
    "a merge of itself": ("lidar: &a\n  <<: *a\n", "a key must be a plain word"),
    "control characters": ("lidar: \x01", "is not YAML"),
    "a number of base 60": ("lidar: 1" + ":1" * 200_000, "a number of 400001 characters"),
}


@pytest.mark.parametrize("name", RIGS)
def test_a_hostile_rig_is_an_error_in_one_line_and_soon(tmp_path, name):
    rig, expected = RIGS[name]
    path = recording(tmp_path, configuration(), rig)
    started_s = time.process_time()
    with pytest.raises(ConfigError) as caught:
        replay_into(tmp_path / "out", path, RunRequest(ROOT / "configs" / "paper_lidar.yaml"))
    assert time.process_time() - started_s < MAX_S
    assert expected in str(caught.value)
    assert "(rig.yaml)" in str(caught.value) or "$rig" in rig


@pytest.mark.parametrize("name", RIGS)
def test_a_hostile_configuration_in_a_recording_is_an_error_in_one_line(tmp_path, name):
    text, _ = RIGS[name]
    text = text if text.startswith(("[", "?")) else "rig:\n" + "".join(f"  {line}\n" for line in text.splitlines())
    if text.startswith("rig"):
        text += yaml.safe_dump({"stages": {"sweep": SWEEP}, "links": {"lidar": LIDAR}})
    with pytest.raises((ConfigError, LinkError)):
        rerun_into(tmp_path / "out", recording(tmp_path, text))


def test_a_recording_has_a_bounded_number_of_stages(tmp_path):
    config = configuration()
    config["stages"] |= {f"s{n}": {"use": "stages.sweep.Sweep"} for n in range(300)}
    with pytest.raises(LinkError, match="more than 200 stages and links"):
        rerun_into(tmp_path / "out", recording(tmp_path, config))
