"""Rain and haze attenuate and reflect light by their formulas."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from links.simulated.kernels.lidar import APERTURE_M
from links.simulated.matrix.sim_vs_real import StaticScene
from links.simulated.sensors.lidar import Lidar, LidarSettings
from links.simulated.world.mesh import RayScene, quads
from links.simulated.world.weather import CLUTTER_REACH_M, RainClutter, Weather, haze_extinction_per_m
from stages.geometry.lidar_models import lidar_profile

VLP16 = lidar_profile("VLP-16")
FOOTPRINT_RAD = VLP16.footprint_rad
START_NS = 1_748_773_230_000_000_000
THRESHOLD = 0.10 / 65.0**2


def _wall(x_m: float, surface: str = "plaster"):
    return quads([[(x_m, -300, -300), (x_m, 300, -300), (x_m, 300, 300), (x_m, -300, 300)]], surface)


def _fire(mesh, sequences: int, weather: Weather, batches: int = 1, **settings):
    """Ranges and reflectivities (n,) and each pulse's cosine to +x."""
    lidar = Lidar(LidarSettings(laser_bias_m=0.0, dropout=0.0, **settings), START_NS, 1, weather)
    stamps = START_NS + VLP16.sequence_ns * np.arange(sequences)[:, None] + VLP16.firing_ns[1] * np.arange(16)
    stamps = stamps.ravel().astype(np.int64)
    eye, around, found = np.eye(3), StaticScene(mesh), []
    for part in np.split(stamps, batches):
        pulses = lidar.fire(part, np.broadcast_to(eye, (len(part), 3, 3)).copy(), np.zeros((len(part), 3)), around)
        found.append((pulses.range_m[0], pulses.reflectivity[0]))
    elevation = np.radians(np.array(VLP16.elevation_deg, dtype=float))[np.arange(len(stamps)) % 16]
    cosine = np.cos(elevation) * np.sin(lidar.azimuth_rad(stamps))
    ranges, shade = (np.concatenate(column) for column in zip(*found, strict=True))
    return ranges, shade, cosine


def test_extinction_is_koschmieders_at_the_wavelength_and_rain_that_of_the_itu() -> None:
    assert Weather().extinction_per_m() == 0.0
    assert haze_extinction_per_m(1000.0, 550.0) == pytest.approx(3.91e-3)
    assert haze_extinction_per_m(3000.0, 903.0) == pytest.approx(3.91 / 3000 * (903 / 550) ** -0.82)
    assert haze_extinction_per_m(300.0, 903.0) == pytest.approx(3.91 / 300)  # fog attenuates all colours alike
    rain = Weather(rain_mmph=25.0).extinction_per_m()
    assert 10 * np.log10(np.exp(rain * 1000)) == pytest.approx(1.076 * 25**0.67)  # dB per km
    both = Weather(rain_mmph=25.0, visibility_m=1000.0).extinction_per_m()
    assert both == pytest.approx(rain + Weather(visibility_m=1000.0).extinction_per_m())


def test_haze_attenuates_by_beer_lambert_in_both_directions() -> None:
    weather = Weather(visibility_m=1000.0)
    clear = _fire(_wall(30.0), 1900, Weather())
    hazy = _fire(_wall(30.0), 1900, weather)
    straight = (clear[2] > 0.99) & (clear[0] > 0) & (hazy[0] > 0)
    share = hazy[1][straight].mean() / clear[1][straight].mean()
    assert share == pytest.approx(np.exp(-2 * weather.extinction_per_m() * 30.0), rel=0.03)


def test_haze_shortens_the_range() -> None:
    def seen(weather: Weather, x_m: float) -> float:
        ranges, _, cosine = _fire(_wall(x_m, "wire"), 1900, weather)
        return float((ranges[cosine > 0.995] > 0).mean())

    assert seen(Weather(), 55.0) > 0.9
    assert seen(Weather(visibility_m=400.0), 55.0) < 0.02
    assert seen(Weather(visibility_m=400.0), 30.0) > 0.95


def test_first_drops_are_a_poisson_process() -> None:
    weather = Weather(rain_mmph=25.0)
    drops = RainClutter(weather, THRESHOLD, 0.5, APERTURE_M, FOOTPRINT_RAD)
    range_m, power = drops.draw(np.random.default_rng(1), 200_000)
    hit = np.isfinite(range_m)
    assert 0.01 < drops.expected < 0.3
    assert hit.mean() == pytest.approx(1 - np.exp(-drops.expected), abs=3e-3)
    assert range_m[hit].min() >= 0.5
    assert range_m[hit].max() < CLUTTER_REACH_M
    assert (power[hit] >= THRESHOLD).all()
    assert not power[~hit].any()


def test_more_rain_gives_more_clutter_and_no_rain_none() -> None:
    expected = [
        RainClutter(Weather(rain_mmph=r), THRESHOLD, 0.5, APERTURE_M, FOOTPRINT_RAD).expected for r in (2, 10, 50)
    ]
    assert expected[0] < expected[1] < expected[2]
    sky = _wall(500.0)
    assert not _fire(sky, 500, Weather())[0].any()
    wet = _fire(sky, 3000, Weather(rain_mmph=25.0))[0]
    nominal = 1 - np.exp(-RainClutter(Weather(rain_mmph=25.0), THRESHOLD, 0.5, APERTURE_M, FOOTPRINT_RAD).expected)
    assert (wet > 0).mean() == pytest.approx(nominal, rel=0.25)  # some drops are below the threshold of a pulse
    assert np.median(wet[wet > 0]) < 4.0


def test_a_near_wall_hides_drops_and_a_bright_one_is_stronger() -> None:
    ranges, _, cosine = _fire(_wall(1.0), 1900, Weather(rain_mmph=50.0))
    facing = cosine > 0.9
    assert (np.abs(ranges[facing] * cosine[facing] - 1.0) < 0.06).mean() > 0.995
    dry = _fire(_wall(20.0), 1900, Weather())[0][facing]
    wet = _fire(_wall(20.0), 1900, Weather(rain_mmph=50.0))[0][facing]
    assert (np.abs(wet - dry) < 0.1).mean() > 0.9


def test_rain_does_not_depend_on_how_pulses_are_batched() -> None:
    weather = Weather(rain_mmph=20.0, visibility_m=2000.0)
    whole, parts = _fire(_wall(25.0), 400, weather), _fire(_wall(25.0), 400, weather, batches=8)
    np.testing.assert_array_equal(whole[0], parts[0])
    np.testing.assert_array_equal(whole[1], parts[1])


def test_wet_asphalt_is_darker_and_wet_paint_is_not() -> None:
    def fraction(surface: str, wetness: float) -> float:
        scene = RayScene(_wall(5.0, surface), wetness)
        return float(scene.cast(np.zeros((1, 3), np.float32), np.array([[1, 0, 0]], np.float32), 9.0)[1][0])

    assert fraction("asphalt", 1.0) == pytest.approx(0.45 * fraction("asphalt", 0.0))
    assert fraction("asphalt", 0.5) == pytest.approx(0.725 * fraction("asphalt", 0.0))
    assert fraction("paint_light", 1.0) == fraction("paint_light", 0.0)
    assert Weather(rain_mmph=1.0).wetness == 0.5
    assert Weather(rain_mmph=9.0).wetness == 1.0


@pytest.mark.parametrize("wrong", [{"rain_mmph": -1}, {"visibility_m": 5}, {"sun_elevation_deg": 91}, {"fog": 1}])
def test_impossible_weather_is_rejected(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Weather(**wrong)
