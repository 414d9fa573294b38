"""Simulated images and edges against the geometry, and sessions against their truth."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.cameras import camera_models
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.cylinders import contour_point, edge_normal_jacobians
from pkmcal.geometry.rigid import apply, inverse, look_at, pose_difference
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import closure
from pkmcal.placement.configurations import draw_configurations, usable
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.session.load import load_session
from pkmcal.session.readings import same_pose
from pkmcal.simulation import (
    Sensor,
    Settings,
    draw_truth,
    load_truth,
    simulate_session,
    true_machine,
)
from pkmcal.simulation.demo import DEMO_MECHANISM, DEMO_SETTINGS
from pkmcal.simulation.render import PixelRays, Scene, ScenePart, render_light, sensor_image
from pkmcal.simulation.scene import CABLE_PIECES, Finish, discs_of, machine_parts, room_of
from pkmcal.simulation.shapes import Ball, Box, Cylinder, Wall
from pkmcal.simulation.surfaces import Lamp, Lighting, Material, SmoothNoise

Z = np.array([0.0, 0.0, 1.0])
DARK = Lighting((), 0.0, 0.0)
FRONT = look_at(np.array([0.0, -1.0, 0.1]), np.zeros(3), Z)


def pinhole(width: int, height: int, focal: float, distortion=(-0.2, 0.08, 1e-3, -2e-3, 0.0)):
    center = [(width - 1) / 2 + 1.3, (height - 1) / 2 - 0.8]
    parameters = np.array([focal, 1.003 * focal, *center, *distortion])
    return camera_models()["pinhole"]((width, height), parameters)


CAMERA = pinhole(640, 480, 600.0)
SMALL = pinhole(200, 150, 178.0)


@pytest.fixture(scope="module")
def machine():
    return load_mechanism("gough-stewart")


@pytest.fixture(scope="module")
def view():
    return PixelRays.of(CAMERA)


def glowing(shape, level=1.0):
    return ScenePart(shape, Material(0.0, emission=level))


def between(a, b, radius):
    a, b = np.array(a, dtype=float), np.array(b, dtype=float)
    length = float(np.linalg.norm(b - a))
    return Cylinder(a, (b - a) / length, radius, length)


def picture(parts, view, lighting=DARK, T_camera_base=FRONT, seed=0):
    return render_light(
        Scene(tuple(parts), lighting), view, T_camera_base, np.random.default_rng(seed)
    )


def predicted_edge(tube, side, upright):
    """Pixels along an edge, across the image first where ``upright``; sorted along the edge."""
    a, u = apply(FRONT, tube.start), FRONT[:3, :3] @ tube.axis
    n = edge_normal_jacobians(a, a + u, np.array(tube.radius), np.array(side)).n
    along = np.linspace(0, tube.length, 400)
    pixel = CAMERA.project(contour_point(a, u, n, np.array(tube.radius), along))
    pixel = pixel if upright else pixel[:, ::-1]
    return pixel[np.argsort(pixel[:, 1])]


@pytest.mark.parametrize(
    ("a", "b", "radius"),
    [
        ((0.1, 0, -0.25), (0.1, 0, 0.25), 0.02),
        ((-0.1, 0, -0.25), (0.1, 0, 0.25), 0.03),
        ((0.05, 0.1, -0.25), (-0.05, -0.1, 0.25), 0.03),
        ((-0.25, 0.1, 0.1), (0.25, -0.1, 0.11), 0.03),
    ],
)
def test_silhouettes_are_where_the_edge_normals_say(a, b, radius, view):
    tube = between(a, b, radius)
    image = picture([glowing(tube)], view)
    upright = abs(tube.axis[2]) > abs(tube.axis[0])
    image = image if upright else image.T
    edges = [predicted_edge(tube, side, upright) for side in (0, 1)]
    low = min(edges, key=lambda pixel: pixel[:, 0].mean())
    for pixel in edges:
        rows = np.arange(max(4, int(pixel[0, 1]) + 9), min(len(image) - 4, int(pixel[-1, 1]) - 9))
        wanted = np.interp(rows, pixel[:, 1], pixel[:, 0])
        # the lit area of seven pixels across the edge gives its place without any fit
        first = np.rint(wanted).astype(int) - 3
        lit = image[rows[:, None], first[:, None] + np.arange(7)].sum(axis=1)
        value = first + 6.5 - lit if pixel is low else first - 0.5 + lit
        error = value - wanted
        assert len(error) > 150
        assert abs(error.mean()) < 0.005
        halves = [part.mean() for part in np.array_split(error, 2)]
        assert np.abs(halves).max() < 0.01
        assert error.std() < 0.05


def test_a_pixel_has_the_mean_over_its_area():
    """As much light as in pixels a quarter as wide, at borders and beside them: of a tube with a
    highlight and of its shadow.
    """
    tube = Material(0.6, gloss=0.3)
    wall = Box(np.array([0.0, 0.3, 0.0]), np.eye(3), np.array([0.3, 0.01, 0.3]))
    parts = [
        ScenePart(between((0.05, 0, -0.2), (-0.03, 0.02, 0.2), 0.02), tube),
        ScenePart(wall, Material()),
    ]
    lamp = Lamp(np.array([0.6, -1.0, 0.4]), radius=0.001, power=0.7, reach=1.3, shadows=True)

    def in_view(scale):
        middle = [100 * scale - 0.5, 75 * scale - 0.5]
        parameters = np.array([178.0 * scale, 178.0 * scale, *middle, 0, 0, 0, 0, 0])
        camera = camera_models()["pinhole"]((200 * scale, 150 * scale), parameters)
        return picture(parts, PixelRays.of(camera), Lighting((lamp,), 0.1, 0.05))

    mean = in_view(4).reshape(150, 4, 200, 4).mean(axis=(1, 3))
    off = in_view(1) - mean
    border = np.abs(np.gradient(mean, axis=1)) > 0.02
    assert np.count_nonzero(border) > 1000
    assert np.ptp(mean) > 0.5
    # samples in a border pixel determine its share to one in thirty
    assert np.abs(off).max() < 0.05 * np.ptp(mean)
    assert np.sqrt(np.mean(off[border] ** 2)) < 0.006
    assert abs(off[border].mean()) < 0.001


def test_nearer_shapes_hide_farther_ones(view):
    upright, level = between((0, 0, -0.2), (0, 0, 0.2), 0.03), ((-0.2, 0, 0), (0.2, 0, 0))
    middle = tuple(np.rint(CAMERA.project(apply(FRONT, np.zeros(3)))).astype(int)[::-1])
    for depth, in_view in ((-0.1, 0.7), (0.1, 0.3)):
        shift = np.array([0, depth, 0])
        other = between(level[0] + shift, level[1] + shift, 0.03)
        parts = [glowing(upright, 0.3), glowing(other, 0.7)]
        for order in (parts, parts[::-1]):
            assert picture(order, view)[middle] == in_view


def test_every_shape_is_entered_on_its_surface_facing_the_ray():
    origin = np.array([0.3, -2.0, 0.4])
    rng = np.random.default_rng(3)
    target = rng.uniform(-0.5, 0.5, (3, 4000))
    d = target - origin[:, None]
    d /= np.linalg.norm(d, axis=0)
    turn = look_at(np.zeros(3), np.array([1.0, 0.5, 0.2]), Z)[:3, :3]
    shapes = [
        between((-0.2, 0, -0.3), (0.2, 0.3, 0.3), 0.1),
        between((0, 0, 0.1), (0.05, -0.2, 0.2), 0.4),
        Ball(np.array([0.1, 0.0, 0.1]), 0.3),
        Box(np.array([0.1, 0.2, -0.1]), turn, np.array([0.2, 0.3, 0.1])),
        Wall(np.array([0.0, 3.0, 0.0]), np.array([0.0, -1.0, 0.0])),
    ]
    for shape in shapes:
        t = shape.enter(origin[:, None], d)
        hit = np.isfinite(t)
        assert hit.sum() > 50
        points = origin[:, None] + t[hit] * d[:, hit]
        normal = shape.normal(points)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1.0, atol=1e-12)
        assert np.all(np.sum(normal * d[:, hit], axis=0) < 1e-9)
        centre, radius = shape.balls()
        near = np.linalg.norm(points[:, :, None] - centre[:, None], axis=0) <= radius + 1e-12
        assert near.any(axis=1).all()


def test_shadows_fall_behind_what_stands_in_the_light(view):
    lamp = Lamp(np.array([0.6, -0.3, 1.2]), 0.03, 1.0, 1.4, shadows=True)
    lighting = Lighting((lamp,), 0.1, 0.1)
    floor = ScenePart(Wall(np.array([0, 0, -0.15]), Z), Material(0.6))
    ball = ScenePart(Ball(np.zeros(3), 0.08), Material(0.6))
    behind = -lamp.place * 0.15 / lamp.place[2]  # on the floor, in line with lamp and ball
    x, y = np.rint(CAMERA.project(apply(FRONT, behind))).astype(int)
    alone, shaded = (picture(parts, view, lighting) for parts in ([floor], [floor, ball]))
    assert shaded[y, x] == pytest.approx(0.06, abs=1e-6)
    assert alone[y, x] > 0.4
    assert np.all(shaded[440:, 600:] == alone[440:, 600:])
    # penumbra: values between light and shadow, not a step
    partial = (shaded > 0.1) & (shaded < 0.9 * alone) & (shaded[y, x] < shaded)
    assert partial.sum() > 50


def test_turned_steel_shows_a_narrow_line_along_the_rod(view):
    lamp = Lamp(np.array([0.8, -1.2, 0.1]), 0.05, 1.0, 1.4)
    rod = between((0, 0, -0.2), (0, 0, 0.2), 0.04)
    noise = SmoothNoise.from_rng(np.random.default_rng(0))
    lighting = Lighting((lamp,), 0.1, 0.1)
    steel = replace(Finish.from_noise(noise).steel, pattern=None, mirror=0.0)
    bright = picture([ScenePart(rod, steel)], view, lighting)
    dull = picture([ScenePart(rod, replace(steel, gloss=0.0))], view, lighting)
    line = (bright - dull)[150:330]
    peak = line.max(axis=1)
    assert peak.min() > 0.15
    assert np.all((line > peak[:, None] / 2).sum(axis=1) < 0.4 * (dull[150:330] > 0).sum(axis=1))


def test_polished_metal_shows_at_its_limb_what_lies_behind(view):
    """A wall in halves, light and dark: each limb of a polished rod has its own half's level, and
    the middle what stands beside the camera; a dull rod has its own level throughout.
    """
    bright, dark = (Material(emission=level, albedo=0.0) for level in (0.8, 0.2))
    halves = [
        ScenePart(Box(np.array([x, 0.5, 0.0]), np.eye(3), np.array([0.5, 0.01, 0.5])), half)
        for x, half in ((-0.5, bright), (0.5, dark))
    ]
    beside = ScenePart(
        Wall(np.array([0.0, -1.5, 0.0]), np.array([0.0, 1.0, 0.0])),
        Material(emission=0.5, albedo=0.0),
    )
    rod = between((0, 0, -0.2), (0, 0, 0.2), 0.04)

    def row(material):
        return picture([ScenePart(rod, material), *halves, beside], view, DARK)[240]

    behind, mirror = row(Material(0.0)), row(Material(0.0, polish=1.0))
    on_rod = np.flatnonzero(behind == 0.0)
    first, last = on_rod[0], on_rod[-1]
    assert mirror[first - 3] == pytest.approx(0.8)
    assert mirror[last + 3] == pytest.approx(0.2)
    assert mirror[first + 1] == pytest.approx(0.8, abs=0.01)
    assert mirror[last - 1] == pytest.approx(0.2, abs=0.01)
    assert mirror[(first + last) // 2] == pytest.approx(0.5, abs=0.01)


def test_a_style_changes_the_legs_alone_and_no_silhouette(machine):
    truth = draw_truth(machine, (SMALL,), Settings(stations=1, configurations=2), 5)
    view, station = PixelRays.of(SMALL), truth.T_camera_base[0]
    noise = SmoothNoise.from_rng(np.random.default_rng(0))
    room = room_of(discs_of(machine), 1.0, noise, np.random.default_rng(1))

    def parts(style, as_built=False):
        finish = Finish.from_noise(noise, style=style)
        pose, readings = truth.T_base_platform[0], truth.joints[0]
        return finish, machine_parts(machine, discs_of(machine), finish, pose, readings, as_built)

    def in_view(parts):
        return picture([*parts, *room.parts], view, room.lighting, station)

    finish, mixed = parts("mixed")
    legs = [part for part in mixed if part.material in (finish.paint, finish.steel)]
    on_legs = picture([glowing(part.shape) for part in legs], view, DARK, station) > 0
    usual = in_view(mixed)
    for style in ("matte", "dark", "metal"):
        light = in_view(parts(style)[1])
        differs = np.abs(light - usual)
        assert np.mean(differs[on_legs] > 0.02) > 0.2
        # other borders are sampled at other points of their pixels
        assert differs[~on_legs].max() < 0.1
        if style == "dark":
            assert light[on_legs].mean() < 0.5 * usual[on_legs].mean()
    _, built = parts("mixed", as_built=True)
    # a motor, a ring and a cable for each leg, and nothing else moved
    assert len(built) == len(mixed) + machine.n_legs * (2 + CABLE_PIECES)
    # they hide a part of the legs, or shade it
    assert 0.02 < np.mean(np.abs(in_view(built) - usual)[on_legs] > 0.05) < 0.5


def test_noise_of_an_image_is_as_stated():
    sensor = Sensor(blur=0.0, exposure=200.0, read_noise=1.5, shot_noise=0.02)
    flat = sensor_image(np.full((200, 200), 0.5), sensor, np.random.default_rng(1)).astype(float)
    assert flat.mean() == pytest.approx(100, abs=0.05)
    # rounding to whole grey levels adds a twelfth
    assert flat.var() == pytest.approx(1.5**2 + 0.02 * 100 + 1 / 12, rel=0.05)


@pytest.fixture(scope="module")
def setting(machine):
    """A true machine, three stations that see it, and 24 poses."""
    truth = draw_truth(machine, (CAMERA,) * 3, Settings(configurations=8), 5)
    return truth.machine, truth.T_camera_base, truth.T_base_platform


def test_edges_have_the_stated_noise(setting):
    machine, T_camera_base, poses = setting
    many = np.repeat(poses, 4, axis=0)
    noise = EdgeNoise(shift=0.2, tilt=0.5)
    rng = np.random.default_rng(2)
    exact, joints = simulate_edges(
        machine, T_camera_base, CAMERA, poses, EdgeNoise(1e-9, 1e-9), rng, joint_noise=0.0
    )
    assert np.abs(closure(machine.layout, machine.values, joints, poses).rows.value).max() < 1e-12
    for e in range(0, len(exact), 97):
        _check_exact(machine, T_camera_base, poses, exact, e)
    once, _ = simulate_edges(machine, T_camera_base, CAMERA, many, EdgeNoise(1e-9, 1e-9), rng)
    noisy, readings = simulate_edges(machine, T_camera_base, CAMERA, many, noise, rng)
    turn = np.einsum("nij,ni->nj", once.basis, noisy.normal - once.normal)
    white = np.linalg.solve(np.linalg.cholesky(noisy.covariance), turn[..., None])[..., 0]
    n = len(noisy)
    assert n > 3000
    np.testing.assert_allclose(white.T @ white / n, np.eye(2), atol=4 * np.sqrt(2 / n))
    residual = readings - machine.inverse(many)
    assert residual.std() == pytest.approx(3e-6, rel=0.1)


def _check_exact(machine, T_camera_base, poses, edges, e):
    """One edge's normal is the geometry's."""
    from pkmcal.mechanisms.closure import limb_ends

    ends = limb_ends(machine.layout, machine.values, np.zeros(6), poses[edges.configuration[e]])
    T, leg = T_camera_base[edges.station[e]], edges.leg[e]
    a, b = apply(T, ends.a[leg]), apply(T, ends.b[leg])
    n = edge_normal_jacobians(a, b, machine.radii()[leg][edges.tube[e]], edges.side[e]).n
    np.testing.assert_allclose(edges.normal[e], n, atol=1e-10)


def test_an_outward_shift_moves_edges_by_pixels(setting):
    machine, T_camera_base, poses = setting
    rng = np.random.default_rng(0)
    sharp, shifted = (
        simulate_edges(
            machine, T_camera_base, CAMERA, poses, EdgeNoise(1e-9, 1e-9, outward=px), rng
        )[0]
        for px in (0.0, 0.2)
    )
    turn = np.einsum("nij,ni->nj", sharp.basis, shifted.normal - sharp.normal)
    np.testing.assert_allclose(turn, 0.2 * sharp.shift, atol=2e-7)
    # the middle of the edge: the first basis vector is its ray; a pixel outward lies on the plane
    middle = sharp.basis[:, :, 0]
    pixel = CAMERA.project(middle)
    by_pixel, _ = CAMERA.ray_jacobians(pixel)
    outward = np.einsum("nij,ni->nj", by_pixel, sharp.normal)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    off = np.sum(CAMERA.ray(pixel + 0.2 * outward) * shifted.normal, axis=1) * 600
    assert np.abs(off).max() < 0.02


def test_seen_edges_are_those_that_an_image_shows(setting, view):
    machine, T_camera_base, poses = setting
    k, station = 1, 1  # leg 2 stands behind leg 5
    edges, joints = simulate_edges(
        machine, T_camera_base, CAMERA, poses, EdgeNoise(1e-9, 1e-9), np.random.default_rng(0),
        images=np.array([[station, k]]), joint_noise=0.0,
    )  # fmt: skip
    noise = SmoothNoise.from_rng(np.random.default_rng(0))
    parts = machine_parts(machine, discs_of(machine), Finish.from_noise(noise), poses[k], joints[k])
    tubes = [
        glowing(part.shape, 1.0 + leg)
        for leg in range(6)
        for part in parts
        if isinstance(part.shape, Cylinder) and _on_leg(machine, part.shape, leg)
    ]
    assert len(tubes) == 12
    image = picture(tubes, view, T_camera_base=T_camera_base[station])
    assert len(edges) < 24
    for e in range(len(edges)):
        pixel = CAMERA.project(edges.basis[e, :, 0])
        by_pixel, _ = CAMERA.ray_jacobians(pixel)
        outward = by_pixel.T @ edges.normal[e]
        x, y = np.rint(pixel - 1.6 * outward / np.linalg.norm(outward)).astype(int)
        assert image[y, x] == 1.0 + edges.leg[e]


def _on_leg(machine, shape, leg):
    """A tube, by its radius, that stands on the line from the leg's base joint."""
    a = machine.base_centers()[leg]
    off = np.linalg.norm(np.cross(a - shape.start, shape.axis))
    radii = machine.radii()[leg]
    return off < 1e-6 and np.abs(radii - shape.radius).min() < 1e-12


def test_wrong_edges_are_other_legs_of_the_same_image(setting):
    machine, T_camera_base, poses = setting
    right, wrong = (
        simulate_edges(
            machine, T_camera_base, CAMERA, poses, EdgeNoise(wrong=part), np.random.default_rng(4)
        )[0]
        for part in (0.0, 0.2)
    )
    changed = np.flatnonzero(np.any(right.normal != wrong.normal, axis=1))
    assert len(changed) / len(right) == pytest.approx(0.2, abs=0.04)
    for e in changed[:30]:
        source = np.flatnonzero(np.all(right.normal == wrong.normal[e], axis=1))
        assert len(source) == 1
        for name in ("station", "configuration", "side"):
            assert getattr(right, name)[source[0]] == getattr(wrong, name)[e]
        assert right.leg[source[0]] != wrong.leg[e]


def test_true_machines_follow_the_tolerances(machine):
    held = "legs[1].base.center.x"
    tie = ("legs[2].length.offset", "legs[3].length.offset")
    table = machine.parameters.with_roles((held,), (tie,))
    nominal = replace(machine, parameters=table)
    rng = np.random.default_rng(0)
    step = np.stack([true_machine(nominal, 2.0, rng).values for _ in range(400)]) - nominal.values
    assert np.all(step[:, table.index(held)] == 0)
    np.testing.assert_array_equal(*(step[:, table.index(name)] for name in tie))
    spread = np.delete(step / table.tolerance, table.index(held), axis=1).std(axis=0)
    np.testing.assert_allclose(spread, 2.0, rtol=0.2)


def test_configurations_are_usable_and_half_of_them_extreme(machine):
    poses, joints = draw_configurations(machine, 60, 0.5, np.random.default_rng(1))
    assert usable(machine, poses, joints).all()
    low, high = machine.joint_ranges.T
    place = (joints - low) / (high - low)
    assert np.all((place > 0.02) & (place < 0.98))
    extreme = np.all((place < 0.04) | (place > 0.96), axis=1).mean()
    assert 0.3 < extreme < 0.7


@pytest.fixture(scope="module")
def simulated(machine, tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "session"
    calls = []
    settings = Settings(stations=2, configurations=2)
    truth = simulate_session(
        folder, machine, SMALL, settings, seed=3, progress=lambda *call: calls.append(call)
    )
    assert calls == [(k, 4) for k in (1, 2, 3, 4)]
    return folder, truth


def test_a_session_loads_back(simulated, machine):
    folder, truth = simulated
    session = load_session(folder)
    assert session.warnings == ()
    assert session.configurations == truth.configurations
    np.testing.assert_array_equal(session.joints, truth.readings)
    np.testing.assert_array_equal(session.machine.values, machine.values)
    assert [s.name for s in session.stations] == list(truth.stations)
    results = [[s, p.configuration] for s, st in enumerate(session.stations) for p in st.images]
    np.testing.assert_array_equal(results, truth.images)
    np.testing.assert_array_equal(session.stations[0].camera.parameters, SMALL.parameters)
    for station, T in zip(session.stations, truth.T_camera_base, strict=True):
        off = pose_difference(inverse(station.T_camera_base), inverse(T))
        assert np.linalg.norm(off[3:]) == pytest.approx(0.05, abs=1e-3)
        assert np.rad2deg(np.linalg.norm(off[:3])) == pytest.approx(5.0, abs=0.1)
    pose = truth.rough[0]
    T_rough = look_at(pose.position, pose.look_at, pose.up)
    np.testing.assert_allclose(T_rough, session.stations[0].T_camera_base, atol=1e-9)


def test_truth_is_consistent_and_reads_back(simulated, machine):
    folder, truth = simulated
    again = load_truth(folder, machine)
    for retained in (truth, again):
        c = closure(
            retained.machine.layout,
            retained.machine.values,
            retained.joints,
            retained.T_base_platform,
        )
        assert np.abs(c.rows.value).max() < 1e-12
    np.testing.assert_array_equal(again.machine.values, truth.machine.values)
    np.testing.assert_array_equal(again.T_camera_base, truth.T_camera_base)
    np.testing.assert_array_equal(again.images, truth.images)
    assert np.abs(truth.readings - truth.joints).max() < 2e-5
    assert np.abs(truth.machine.values - machine.values).max() > 1e-3


def test_the_seed_decides_everything_and_the_number_of_workers_nothing(
    simulated, machine, tmp_path
):
    folder, truth = simulated
    settings = Settings(stations=2, configurations=2)
    simulate_session(tmp_path / "one", machine, SMALL, settings, seed=3, workers=1)
    names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(names) == 4 + 5
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / "one" / name).read_bytes()
    other = draw_truth(machine, (SMALL,) * 2, settings, 4)
    assert not np.isclose(other.T_camera_base[:, :3, 3], truth.T_camera_base[:, :3, 3]).any()
    assert not np.allclose(other.joints, truth.joints)


def test_images_have_grey_levels_of_a_image(simulated):
    import cv2

    folder, _ = simulated
    for path in folder.rglob("*.png"):
        levels = np.percentile(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), [5, 50, 99.5])
        assert levels[0] < 40 < levels[1] + 15 < 140 < levels[2] + 20


def test_shared_configurations_are_imaged_by_all(machine):
    truth = draw_truth(machine, (SMALL,) * 3, Settings(configurations=4, shared=True), 1)
    assert truth.T_base_platform.shape == (4, 4, 4)
    assert {tuple(pair) for pair in truth.images} == {(s, k) for s in range(3) for k in range(4)}


@pytest.mark.parametrize("name", ["gough-stewart", "delta"])
@pytest.mark.parametrize("shared", [False, True])
def test_configurations_are_of_different_poses(name, shared):
    settings = Settings(configurations=15, shared=shared)
    truth = draw_truth(load_mechanism(name), (default_camera(),) * 3, settings, 1)
    owner = same_pose(truth.readings, settings.joint_noise)
    assert len(np.unique(owner)) == len(truth.readings) == (15 if shared else 45)
    low, high = truth.machine.joint_ranges.T
    place = (truth.joints - low) / (high - low)
    extreme = np.sum(np.all((place < 0.04) | (place > 0.96), axis=1))
    # about half, or as many as there are: a delta has eight
    assert 0.3 * len(place) < extreme < 0.7 * len(place) or extreme == 8


def test_images_by_hand_are_of_different_poses():
    settings = Settings(configurations=12, repeats=2, handheld=True)
    truth = draw_truth(load_mechanism("delta"), (default_camera(),) * 24, settings, 1)
    assert len(np.unique(same_pose(truth.readings, settings.joint_noise))) == 12


def test_more_ends_of_the_ranges_than_there_are_cannot_be_had():
    settings = Settings(configurations=15, extreme=1.0)
    # three arms, each near one of two ends
    with raises(GeometryError, found="8", expected="45"):
        draw_truth(load_mechanism("delta"), (default_camera(),) * 3, settings, 1)


def test_a_session_is_written_whole_or_not_at_all(machine, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    settings = Settings(stations=1, configurations=2)
    with pytest.raises(KeyboardInterrupt):
        simulate_session(tmp_path / "new", machine, SMALL, settings, progress=stop)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "notes.txt").write_text("mine")
    with raises(InputError, code="output.not_empty", where=str(tmp_path / "old")):
        simulate_session(tmp_path / "old", machine, SMALL, settings)
    with raises(InputError, found="2 cameras for 1 stations"):
        simulate_session(tmp_path / "new", machine, (SMALL, SMALL), settings)


def test_the_demonstration_can_be_drawn():
    camera = default_camera()
    machine = load_mechanism(DEMO_MECHANISM)
    truth = draw_truth(machine, (camera,) * DEMO_SETTINGS.n_stations, DEMO_SETTINGS, 7)
    assert len(truth.images) == 18


def test_importing_is_quick():
    code = (
        "import sys, pkmcal.simulation; "
        "sys.exit(any(name in sys.modules for name in ('cv2', 'scipy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
