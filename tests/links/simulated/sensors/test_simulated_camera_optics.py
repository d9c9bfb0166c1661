"""Dirt and flare of a simulated lens, and reflections in window glass."""

from __future__ import annotations

import numpy as np

from links.simulated.sensors.camera_paint import Street
from links.simulated.sensors.camera_rays import CameraScene
from links.simulated.sensors.camera_sensor import dirt, flare
from links.simulated.world.mesh import RayScene, merge, quads
from links.simulated.world.sky import light
from links.simulated.world.weather import Weather

SIZE = 200
SUN_RGB = np.array([1.0, 0.9, 0.8])


def test_dirt_takes_light_and_grows_with_the_spots():
    rows, columns = np.divmod(np.arange(SIZE * SIZE), SIZE)
    some, more = (dirt(rows, columns, SIZE, spots, np.random.default_rng(1)) for spots in (4, 40))
    for clean in (some, more):
        assert clean.min() > 0.0
        assert clean.max() <= 1.0
    assert 0.8 < more.mean() < some.mean() < 1.0
    assert dirt(rows, columns, SIZE, 0, np.random.default_rng(1)).min() == 1.0


def test_glare_is_brightest_at_the_sun_and_ghosts_lie_on_the_line_through_the_centre():
    image = np.zeros((SIZE, SIZE, 3), dtype=np.float32)
    sun, centre = np.array([150.0, 80.0]), np.array([99.5, 99.5])
    flare(image, sun, centre, 1.0, SUN_RGB)
    row, column = np.unravel_index(np.argmax(image[..., 0]), (SIZE, SIZE))
    assert (column, row) == (150, 80)
    ghost, mirrored = (
        np.rint(centre + share * (sun - centre) * [1, turn]).astype(int) for share, turn in ((-0.9, 1), (-0.9, -1))
    )
    assert image[ghost[1], ghost[0], 2] > 1.2 * image[mirrored[1], mirrored[0], 2]
    twice = np.zeros_like(image)
    flare(twice, sun, centre, 2.0, SUN_RGB)
    np.testing.assert_allclose(twice, 2 * image, rtol=1e-5)


def test_a_window_reflects_the_wall_across_the_street_only_with_reflections():
    """A camera at the origin looks at a pane at x = 5; behind the camera, at x = -8, stands a wall."""
    pane = quads([[(5, -2, -2), (5, 2, -2), (5, 2, 2), (5, -2, 2)]], "glass")
    wall = quads([[(-8, -9, -9), (-8, 9, -9), (-8, 9, 9), (-8, -9, 9)]], "plaster")
    street = Street(0.0, 0.0, -1.8, 0.0)
    directions = np.array([[1.0, 0.05, 0.06], [1.0, -0.2, 0.1], [-1.0, 0.1, 0.2]], dtype=np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = {}
    for world in ("pane", "both"):
        mesh = pane if world == "pane" else merge([pane, wall])
        for reflections in (False, True):
            scene = CameraScene(RayScene(mesh), mesh, (), street, light(Weather(), 1), reflections=reflections)
            zero = np.zeros(3, dtype=np.int64)
            samples = scene.trace(np.zeros((3, 3), dtype=np.float32), directions, zero, np.zeros(1, dtype=np.int64))
            samples.lit[:] = False  # the wall's shadow on the pane does not matter here
            found[world, reflections] = scene.radiance(samples, 0.005)
    np.testing.assert_array_equal(found["pane", False], found["pane", True])  # only the sky to reflect
    np.testing.assert_array_equal(found["both", False][:2], found["pane", False][:2])
    assert (np.abs(found["both", True][:2] - found["both", False][:2]).max(axis=1) > 1e-4).all()
    np.testing.assert_array_equal(found["both", True][2], found["both", False][2])
