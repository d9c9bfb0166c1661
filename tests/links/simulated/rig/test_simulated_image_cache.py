"""Images of an earlier recording replace rendered ones, to the byte, or are rejected with a reason."""

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
    """0.5 s, two 64 px cameras whose images may arrive out of order, a drone with flight dynamics."""
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
def recorded(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> FilePath:
    file = tmp_path_factory.mktemp("recorded") / "recorded.mcap"
    simulate_into(file, scenario)
    return file


@pytest.fixture
def no_rendering(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(camera_view, "render")
    monkeypatch.setattr("links.simulated.sensors.camera.render", None)


def records_of(file: FilePath) -> list[Record]:
    with RecordingReader(file) as reader:
        return list(reader.records())


def test_the_same_flight_is_the_same_file_to_the_byte_without_rendering(
    scenario, recorded, tmp_path, no_rendering
) -> None:
    simulate_into(tmp_path / "again.mcap", scenario, images=recorded)
    assert (tmp_path / "again.mcap").read_bytes() == recorded.read_bytes()
    images = [record for record in records_of(recorded) if record.topic.startswith("/camera/")]
    assert len(images) >= 12
    per_camera = [[r.stamp_ns for r in images if r.topic == f"/camera/{c}"] for c in ("vehicle", "drone")]
    assert any(stamps != sorted(stamps) for stamps in per_camera), "none was overtaken: the test asks too little"


def test_another_servo_lidar_or_radio_keeps_all_images(scenario, recorded, tmp_path, no_rendering) -> None:
    other = scenario.changed(
        servo={"start_deg": 30.0, "encoder_error_deg": 0.2},
        autopilot={"attitude_hz": 10.0},
        vehicle_odometry=None,
        script=({"do": "sweep", "times": 3},),
        name="other",
    )
    simulate_into(tmp_path / "other.mcap", other, images=recorded)
    there, here = records_of(recorded), records_of(tmp_path / "other.mcap")
    images = [
        [(r.topic, r.arrival_ns, r.stamp_ns, r.data) for r in records if r.topic.startswith("/camera/")]
        for records in (there, here)
    ]
    assert images[0] == images[1]
    packets = [[r.data for r in records if r.topic == "/lidar/packets"] for records in (there, here)]
    assert packets[0] != packets[1]


@pytest.mark.slow
def test_a_shorter_flight_uses_the_images_that_it_would_have_rendered(scenario, recorded) -> None:
    shorter = scenario.changed(duration_s=0.3)
    assert list(Simulation(shorter, images=ImageCache(recorded, shorter)).records()) == list(
        Simulation(shorter).records()
    )


@pytest.fixture(scope="module")
def closed_path(scenario: Scenario) -> Scenario:
    """A parked vehicle, a drone on a closed path of one second; two laps."""
    waypoints = [{"t_s": t, "xyz_m": (4.0 + x, 3.0, 6.0)} for t, x in ((0.0, 0.0), (0.5, 0.4))]
    drone = {"path": {"period_s": 1.0, "waypoints": waypoints}}
    one = CameraSettings(size_px=64, rate_hz=5, latency_ms=(5.0, 300.0))
    return scenario.changed(
        vehicle={}, drone=drone, duration_s=2.6, cameras=CamerasSettings(vehicle=one, drone=one), vehicle_odometry=None
    )


def test_images_of_the_first_lap_repeat_with_a_delay(closed_path, tmp_path) -> None:
    simulate_into(tmp_path / "first.mcap", closed_path.changed(duration_s=1.4))
    kept = ImageCache(tmp_path / "first.mcap", closed_path)
    records = [r for r in Simulation(closed_path, images=kept).records() if r.topic.startswith("/camera/")]
    for topic in ("/camera/vehicle", "/camera/drone"):
        seen = sorted((r for r in records if r.topic == topic), key=lambda r: r.stamp_ns)
        assert len(seen) >= 11
        for first, second in zip(seen, seen[5:], strict=False):
            assert second.stamp_ns == first.stamp_ns + 10**9
            a, b = decode_compressed_image(first.data), decode_compressed_image(second.data)
            assert (a.data, a.stamp_ns, b.stamp_ns) == (b.data, first.stamp_ns, second.stamp_ns)
        assert len({r.data for r in seen[:5]}) == 5
        assert all(r.arrival_ns >= r.stamp_ns for r in seen)


@pytest.mark.slow
def test_a_flight_no_longer_than_the_recorded_one_uses_its_own_images_after_the_first_lap(
    closed_path, tmp_path
) -> None:
    once = closed_path.changed(duration_s=1.5, cameras={"vehicle": {"size_px": 64, "rate_hz": 4.5}})
    simulate_into(tmp_path / "first.mcap", once)
    simulate_into(tmp_path / "again.mcap", once, images=tmp_path / "first.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "first.mcap").read_bytes()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"vehicle": {"suspension": {}}}, "duration_s is 1.4 in it, 2.6 now"),
        ({"scene": {"birds": 1}}, "duration_s is 1.4 in it, 2.6 now"),
        ({"cameras": {"vehicle": {"size_px": 64, "rate_hz": 4.5}}}, "4.5 Hz are 4.50 images in a lap of 1 s"),
    ],
)
@pytest.mark.slow
def test_images_do_not_repeat_where_they_would_differ(closed_path, tmp_path, change, text) -> None:
    longer = closed_path.changed(**change)
    simulate_into(tmp_path / "first.mcap", longer.changed(duration_s=1.4))
    with pytest.raises(LinkError, match=text.replace(".", r"\.")):
        Simulation(longer, images=ImageCache(tmp_path / "first.mcap", longer))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seed": 8}, "seed is 7 in it, 8 now"),
        ({"weather": {"rain_mmph": 5.0}}, "weather.rain_mmph is 0.0 in it, 5.0 now"),
        ({"scene": {"kind": "campus"}}, "scene.kind is street in it, campus now"),
        ({"autopilot": {"flight": {"gust_mps": 2.0}}}, "autopilot.flight.gust_mps is 0.5 in it, 2.0 now"),
        ({"autopilot": None}, "autopilot.flight is given in it, not given now"),
        ({"cameras": {"vehicle": {"size_px": 64, "rate_hz": 10}}}, "cameras.vehicle.rate_hz is 15.0 in it, 10.0 now"),
        ({"vehicle": {"suspension": {}}}, "vehicle.path.waypoints is a list of 2 in it, a list of 1 now"),
        ({"duration_s": 0.6}, "duration_s is 0.5 in it, 0.6 now"),
        (
            {"true_mount": {"T_vehicle_turntable": {"xyz_m": (0, 0, 0.5)}, "T_turntable_lidar": {}}},
            "mount.T_vehicle_turntable.xyz_m.2 is 0.25 in it, 0.5 now",
        ),
        ({"cameras": {}}, "has no cameras: leave out --images"),
    ],
)
def test_images_of_another_flight_are_rejected_with_the_first_difference(scenario, recorded, change, text) -> None:
    with pytest.raises(LinkError, match=text.replace(".", r"\.")):
        ImageCache(recorded, scenario.changed(**change))


def rewritten(recorded: FilePath, file: FilePath, keep, made_by: str = "grd simulate") -> FilePath:
    """The recording with some of its records removed or changed."""
    with RecordingReader(recorded) as reader:
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


def test_a_recording_with_another_motion_and_the_same_settings_is_rejected(scenario, recorded, tmp_path) -> None:
    def pushed(record: Record) -> Record:
        if record.topic != "/truth/drone" or record.stamp_ns < scenario.start_ns + 2 * 10**8:
            return record
        pose = json.loads(record.data)
        pose["xyz_m"][1] += 0.01
        return Record(record.topic, record.arrival_ns, record.stamp_ns, json.dumps(pose).encode(), record.sequence)

    file = rewritten(recorded, tmp_path / "pushed.mcap", pushed)
    with pytest.raises(LinkError, match=r"drone has another pose at 0\.20 s"):
        Simulation(scenario, images=ImageCache(file, scenario))


def test_a_missing_image_ends_the_simulation_with_its_stamp(scenario, recorded, tmp_path) -> None:
    stamps = [r.stamp_ns for r in records_of(recorded) if r.topic == "/camera/drone"]
    lost = sorted(stamps)[3]
    file = rewritten(
        recorded, tmp_path / "lost.mcap", lambda r: None if (r.topic, r.stamp_ns) == ("/camera/drone", lost) else r
    )
    with pytest.raises(LinkError, match=f"no image on /camera/drone with stamp {lost}"):
        list(Simulation(scenario, images=ImageCache(file, scenario)).records())
    blind = rewritten(recorded, tmp_path / "blind.mcap", lambda r: None if r.topic == "/camera/vehicle" else r)
    with pytest.raises(LinkError, match="has nothing on /camera/vehicle"):
        ImageCache(blind, scenario)


def test_images_are_rejected_from_real_recordings_and_from_the_output_file(scenario, recorded, tmp_path) -> None:
    real = rewritten(recorded, tmp_path / "real.mcap", lambda record: record, made_by="grd run")
    with pytest.raises(LinkError, match="is no simulated recording"):
        ImageCache(real, scenario)
    with pytest.raises(LinkError, match="no such file"):
        ImageCache(tmp_path / "nothing.mcap", scenario)
    with pytest.raises(LinkError, match="both the output and the source of the images"):
        simulate_into(recorded, scenario, overwrite=True, images=recorded)


def test_a_list_of_other_length_is_a_difference_and_an_equal_tree_none() -> None:
    assert first_difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 2}]}) is None
    assert first_difference({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}) == ("a.1.b", "2", "3")
    assert first_difference({"a": [1]}, {"a": [1, 2]}) == ("a", "a list of 1", "a list of 2")
    assert first_difference({"a": 1}, {"a": 1, "b": 2}) == ("b", "not given", "2")


def test_the_commands_use_images_and_state_what_is_missing(scenario, recorded, tmp_path) -> None:
    file = tmp_path / "scenario.yaml"
    file.write_text(scenario.as_yaml(), encoding="utf-8")
    arguments = ["simulate", file, "-o", tmp_path / "again.mcap", "--images", recorded]
    again = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again.mcap").read_bytes() == recorded.read_bytes()
    matrix = ["matrix", tmp_path / "m", "--only", "open_lot-10m-hover-parked", "--images", tmp_path]
    blind = CliRunner().invoke(app, [str(argument) for argument in matrix])
    assert blind.exit_code == 2
    assert "--cameras HZ" in blind.output
    missing = CliRunner().invoke(app, [str(argument) for argument in [*matrix, "--cameras", "5"]])
    assert missing.exit_code == 2
    assert "open_lot-10m-hover-parked-s1.mcap: no such file" in " ".join(missing.output.split())
