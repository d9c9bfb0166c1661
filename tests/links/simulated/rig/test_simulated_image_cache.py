"""Images of an earlier recording stand for painted ones, to the byte, or are refused by name."""

from __future__ import annotations

import json
from pathlib import Path as FilePath

import pytest
from typer.testing import CliRunner

from flow.link import LinkError, Record
from links.cli.app import app
from links.recording import RecordingReader, RecordingWriter, decode_compressed_image
from links.simulated.rig.image_cache import ImageCache, first_difference
from links.simulated.rig.run import Simulation, simulate_into
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.sensors import camera_view
from links.simulated.sensors.camera import CameraSettings, CamerasSettings
from links.simulated.world.path import Path, Waypoint

STREET = FilePath(__file__).parents[4] / "configs/scenarios/street_sweep.yaml"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """0.5 s, two 64 px cameras whose images may overtake each other, a drone that flies by its dynamics."""
    drone = Path(waypoints=(Waypoint(t_s=0, xyz_m=(4.0, 3.0, 6.0)), Waypoint(t_s=1.0, xyz_m=(6.0, 3.0, 6.0))))
    vehicle = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0)), Waypoint(t_s=1.0, xyz_m=(3.0, 0, 0))))
    one = CameraSettings(size_px=64, rate_hz=15, latency_ms=(5.0, 200.0))
    return (
        load_scenario(STREET)
        .with_drone(drone)
        .changed(
            duration_s=0.5,
            vehicle={"path": vehicle},
            cameras=CamerasSettings(vehicle=one, drone=one),
            autopilot={},
            vehicle_odometry={},
        )
    )


@pytest.fixture(scope="module")
def painted(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> FilePath:
    file = tmp_path_factory.mktemp("painted") / "painted.mcap"
    simulate_into(file, scenario)
    return file


@pytest.fixture
def no_painting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(camera_view, "render")
    monkeypatch.setattr("links.simulated.sensors.camera.render", None)


def records_of(file: FilePath) -> list[Record]:
    with RecordingReader(file) as reader:
        return list(reader.records())


def test_the_same_flight_is_the_same_file_to_the_byte_and_nothing_is_painted(
    scenario, painted, tmp_path, no_painting
) -> None:
    simulate_into(tmp_path / "again.mcap", scenario, images=painted)
    assert (tmp_path / "again.mcap").read_bytes() == painted.read_bytes()
    images = [record for record in records_of(painted) if record.topic.startswith("/camera/")]
    assert len(images) >= 12
    per_camera = [[r.stamp_ns for r in images if r.topic == f"/camera/{c}"] for c in ("vehicle", "drone")]
    assert any(stamps != sorted(stamps) for stamps in per_camera), "none was overtaken: the test asks too little"


def test_another_servo_lidar_or_radio_keeps_every_picture(scenario, painted, tmp_path, no_painting) -> None:
    other = scenario.changed(
        servo={"start_deg": 30.0, "encoder_error_deg": 0.2},
        autopilot={"attitude_hz": 10.0},
        vehicle_odometry=None,
        script=({"do": "sweep", "times": 3},),
        name="other",
    )
    simulate_into(tmp_path / "other.mcap", other, images=painted)
    there, here = records_of(painted), records_of(tmp_path / "other.mcap")
    images = [
        [(r.topic, r.arrival_ns, r.stamp_ns, r.data) for r in records if r.topic.startswith("/camera/")]
        for records in (there, here)
    ]
    assert images[0] == images[1]
    packets = [[r.data for r in records if r.topic == "/lidar/packets"] for records in (there, here)]
    assert packets[0] != packets[1]


def test_a_shorter_flight_takes_the_pictures_that_it_would_have_painted(scenario, painted) -> None:
    shorter = scenario.changed(duration_s=0.3)
    assert list(Simulation(shorter, images=ImageCache(painted, shorter)).records()) == list(
        Simulation(shorter).records()
    )


@pytest.fixture(scope="module")
def round_about(scenario: Scenario) -> Scenario:
    """A parked vehicle, a drone that is back after a second; two of its rounds."""
    way = [{"t_s": t, "xyz_m": (4.0 + x, 3.0, 6.0)} for t, x in ((0.0, 0.0), (0.5, 0.4))]
    drone = {"path": {"period_s": 1.0, "waypoints": way}}
    one = CameraSettings(size_px=64, rate_hz=5, latency_ms=(5.0, 300.0))
    return scenario.changed(
        vehicle={}, drone=drone, duration_s=2.6, cameras=CamerasSettings(vehicle=one, drone=one), vehicle_odometry=None
    )


def test_round_and_round_the_first_rounds_pictures_come_again_so_much_later(round_about, tmp_path) -> None:
    simulate_into(tmp_path / "first.mcap", round_about.changed(duration_s=1.4))
    kept = ImageCache(tmp_path / "first.mcap", round_about)
    records = [r for r in Simulation(round_about, images=kept).records() if r.topic.startswith("/camera/")]
    for topic in ("/camera/vehicle", "/camera/drone"):
        seen = sorted((r for r in records if r.topic == topic), key=lambda r: r.stamp_ns)
        assert len(seen) >= 11
        for first, second in zip(seen, seen[5:], strict=False):
            assert second.stamp_ns == first.stamp_ns + 10**9
            a, b = decode_compressed_image(first.data), decode_compressed_image(second.data)
            assert (a.data, a.stamp_ns, b.stamp_ns) == (b.data, first.stamp_ns, second.stamp_ns)
        assert len({r.data for r in seen[:5]}) == 5
        assert all(r.arrival_ns >= r.stamp_ns for r in seen)


def test_a_flight_no_longer_than_the_recorded_one_takes_its_own_pictures_beyond_a_round_too(
    round_about, tmp_path
) -> None:
    once = round_about.changed(duration_s=1.5, cameras={"vehicle": {"size_px": 64, "rate_hz": 4.5}})
    simulate_into(tmp_path / "first.mcap", once)
    simulate_into(tmp_path / "again.mcap", once, images=tmp_path / "first.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "first.mcap").read_bytes()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"vehicle": {"ride": {}}}, "duration_s is 1.4 there, 2.6 here"),
        ({"scene": {"birds": 1}}, "duration_s is 1.4 there, 2.6 here"),
        ({"cameras": {"vehicle": {"size_px": 64, "rate_hz": 4.5}}}, "4.5 Hz are 4.50 images in a round of 1 s"),
    ],
)
def test_pictures_do_not_come_again_where_something_else_would_be_seen(round_about, tmp_path, change, says) -> None:
    longer = round_about.changed(**change)
    simulate_into(tmp_path / "first.mcap", longer.changed(duration_s=1.4))
    with pytest.raises(LinkError, match=says.replace(".", r"\.")):
        Simulation(longer, images=ImageCache(tmp_path / "first.mcap", longer))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 8}, "seed is 7 there, 8 here"),
        ({"weather": {"rain_mmph": 5.0}}, "weather.rain_mmph is 0.0 there, 5.0 here"),
        ({"scene": {"kind": "campus"}}, "scene.kind is street there, campus here"),
        ({"autopilot": {"flight": {"gust_mps": 2.0}}}, "autopilot.flight.gust_mps is 0.5 there, 2.0 here"),
        ({"autopilot": None}, "autopilot.flight is given there, not given here"),
        ({"cameras": {"vehicle": {"size_px": 64, "rate_hz": 10}}}, "cameras.vehicle.rate_hz is 15.0 there, 10.0 here"),
        ({"vehicle": {"ride": {}}}, "vehicle.path.waypoints is a list of 2 there, a list of 1 here"),
        ({"duration_s": 0.6}, "duration_s is 0.5 there, 0.6 here"),
        (
            {"true_mount": {"T_vehicle_turntable": {"xyz_m": (0, 0, 0.5)}, "T_turntable_lidar": {}}},
            "mount.T_vehicle_turntable.xyz_m.2 is 0.25 there, 0.5 here",
        ),
        ({"cameras": {}}, "has no cameras: leave --images out"),
    ],
)
def test_pictures_of_another_flight_are_refused_and_the_first_difference_is_named(
    scenario, painted, change, says
) -> None:
    with pytest.raises(LinkError, match=says.replace(".", r"\.")):
        ImageCache(painted, scenario.changed(**change))


def rewritten(painted: FilePath, file: FilePath, keep, made_by: str = "grd simulate") -> FilePath:
    """The recording with only some of its records, or changed ones."""
    with RecordingReader(painted) as reader:
        assert reader.rig_yaml is not None
        assert reader.config_yaml is not None
        with RecordingWriter(
            file,
            rig_yaml=reader.rig_yaml,
            config_yaml=reader.config_yaml,
            metadata={"made_by": made_by},
            lossless=True,
        ) as writer:
            for record in filter(None, map(keep, reader.records())):
                writer.write(record)
    return file


def test_a_recording_that_flew_otherwise_with_the_same_settings_is_refused(scenario, painted, tmp_path) -> None:
    def pushed(record: Record) -> Record:
        if record.topic != "/truth/drone" or record.stamp_ns < scenario.start_ns + 2 * 10**8:
            return record
        told = json.loads(record.data)
        told["xyz_m"][1] += 0.01
        return Record(record.topic, record.arrival_ns, record.stamp_ns, json.dumps(told).encode(), record.sequence)

    file = rewritten(painted, tmp_path / "pushed.mcap", pushed)
    with pytest.raises(LinkError, match=r"drone was elsewhere at 0\.20 s"):
        Simulation(scenario, images=ImageCache(file, scenario))


def test_a_picture_that_is_missing_ends_the_simulation_with_its_stamp(scenario, painted, tmp_path) -> None:
    stamps = [r.stamp_ns for r in records_of(painted) if r.topic == "/camera/drone"]
    lost = sorted(stamps)[3]
    file = rewritten(
        painted, tmp_path / "lost.mcap", lambda r: None if (r.topic, r.stamp_ns) == ("/camera/drone", lost) else r
    )
    with pytest.raises(LinkError, match=f"no image on /camera/drone stamped {lost}"):
        list(Simulation(scenario, images=ImageCache(file, scenario)).records())
    blind = rewritten(painted, tmp_path / "blind.mcap", lambda r: None if r.topic == "/camera/vehicle" else r)
    with pytest.raises(LinkError, match="has nothing on /camera/vehicle"):
        ImageCache(blind, scenario)


def test_no_simulation_no_pictures_and_never_the_file_that_is_written(scenario, painted, tmp_path) -> None:
    flown = rewritten(painted, tmp_path / "flown.mcap", lambda record: record, made_by="grd run")
    with pytest.raises(LinkError, match="is no simulated recording"):
        ImageCache(flown, scenario)
    with pytest.raises(LinkError, match="no such file"):
        ImageCache(tmp_path / "nothing.mcap", scenario)
    with pytest.raises(LinkError, match="both what is written and where images come from"):
        simulate_into(painted, scenario, overwrite=True, images=painted)


def test_a_list_of_other_length_is_a_difference_and_an_equal_tree_none() -> None:
    assert first_difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 2}]}) is None
    assert first_difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}) == ("a.1.b", "2", "3")
    assert first_difference({"a": [1]}, {"a": [1, 2]}) == ("a", "a list of 1", "a list of 2")
    assert first_difference({"a": 1}, {"a": 1, "b": 2}) == ("b", "not given", "2")


def test_the_commands_take_pictures_and_say_what_is_missing(scenario, painted, tmp_path) -> None:
    file = tmp_path / "scenario.yaml"
    file.write_text(scenario.as_yaml(), encoding="utf-8")
    asked = ["simulate", file, "-o", tmp_path / "again.mcap", "--images", painted]
    again = CliRunner().invoke(app, [str(word) for word in asked])
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again.mcap").read_bytes() == painted.read_bytes()
    matrix = ["matrix", tmp_path / "m", "--only", "open_lot-10m-hover-parked", "--images", tmp_path]
    blind = CliRunner().invoke(app, [str(word) for word in matrix])
    assert blind.exit_code == 2
    assert "--cameras HZ" in blind.output
    missing = CliRunner().invoke(app, [str(word) for word in [*matrix, "--cameras", "5"]])
    assert missing.exit_code == 2
    assert "open_lot-10m-hover-parked-s1.mcap: no such file" in " ".join(missing.output.split())
