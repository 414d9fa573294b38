"""Localization of a station in images, and each leg found to a pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pkmcal.calibration.localization import localize_by_legs, platform_poses, read_images
from pkmcal.geometry.rigid import inverse, perturb, pose, pose_difference, rotation
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe import pose_likelihood, station_localization
from pkmcal.observe.distance_tables import (
    DISTANCE_TABLE_OPTIONS,
    direction_of,
    distance_tables,
)
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.legs import LEG_SEARCH_OPTIONS, search, search_legs
from pkmcal.observe.pose_likelihood import StationView, score
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of, unobstructed
from pkmcal.observe.shadows import without_shadows
from pkmcal.observe.station_localization import LOCALIZATION_OPTIONS, find_station
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings, load_truth, simulate_session
from test_observe_rendered_legs import (
    FRONT,
    camera_of,
    draw,
    machine,
    outward_to,
    poses,
    redrawn,
    rendered_images,
    true_normals,
    tubes_at,
)

CLEARANCE = 5.0


def images():
    return rendered_images()[0]


# Legs


def located(mechanism, pictures, samples=12):
    """Legs searched from a mechanism's prediction, and where their edges really are.

    Returns the places, found and true outward positions (K, E, n) px, and which count.
    """
    readings = machine().inverse(poses())[: len(pictures)]
    in_view = poses()[: len(pictures)]
    tubes, camera = tubes_of(mechanism), camera_of()
    legs = legs_in_camera(mechanism, FRONT, in_view, readings)
    points = edge_points(mechanism, camera, legs, tubes, samples)
    clear = unobstructed(mechanism, camera, legs, tubes, points, CLEARANCE)
    places = search_legs(pictures, tubes, points, clear)
    k, e = np.indices(clear.shape[:2])
    flat = (v.ravel() for v in (tubes.leg[e], tubes.tube[e], tubes.side[e], k))
    normal = true_normals(*flat).reshape(*clear.shape[:2], 3)
    truth = outward_to(normal, points.pixel, points.outward, camera)
    counted = clear & places.clear[:, tubes.leg][..., None]
    return places, places.outward(points, clear, tubes), truth, counted


@pytest.mark.parametrize("spread", [0.0, 0.001, 0.002, 0.004])
def test_legs_are_found_where_a_wrong_nominal_model_does_not_put_them(spread):
    """Nominal errors of up to 4 mm shift and tilt legs by up to ten pixels: found to 0.6 px.

    Shifts are tried by whole pixels and tilts too, so 0.3 px each is the best possible.
    """
    shifts = []
    for seed in range(2):
        places, value, truth, counted = located(redrawn(seed, spread), images())
        assert places.clear.mean() > 0.8
        off = (value - truth)[counted]
        assert np.sqrt(np.mean(off**2)) < 0.6
        assert np.abs(off).max() < 2.0
        shifts.append(np.abs(truth[counted]).max())
    assert max(shifts) > 2000 * spread - 0.1


def test_a_leg_that_is_not_there_is_not_found():
    """The image without leg 3: the others are found as before, leg 3 is nowhere clear."""
    without = [draw([t for t in tubes_at(machine(), T) if t.leg != 2])[0] for T in poses()[:3]]
    places, value, truth, counted = located(redrawn(0, 0.001), without)
    assert not places.clear[:, 2].any()
    assert places.clear[:, [0, 1, 3, 4, 5]].mean() > 0.7
    assert np.sqrt(np.mean((value - truth)[counted] ** 2)) < 0.6


def test_a_leg_beyond_the_search_is_not_found():
    """All edges moved sideways by more than the reach: the place at its end is no place. A few
    legs meet their neighbours' edges instead."""
    far = int(LEG_SEARCH_OPTIONS.reach) + 6
    shifted = [np.roll(image, far, axis=1) for image in images()]
    assert located(machine(), shifted)[0].clear.mean() < 0.35


def test_what_a_search_gives_and_why_it_leaves_legs_out():
    """Edges with sigmas of about a pixel; every leg that is left out has a reason."""
    pictures, readings = images(), machine().inverse(poses())
    taken = StationImages(3, camera_of(), np.arange(6), readings, pictures)
    wrong = redrawn(1, 0.001)
    value = search(taken, wrong, FRONT, poses())
    edges = value.edges
    assert set(edges.station) == {3}
    truth = true_normals(edges.leg, edges.tube, edges.side, edges.configuration)
    shift = np.einsum("nij,ni->nj", edges.basis, edges.normal - truth)[:, 0] / edges.shift[:, 0]
    assert np.sqrt(np.mean(shift**2)) < 0.6
    sigma = np.sqrt(edges.covariance[:, 0, 0]) / np.abs(edges.shift[:, 0])
    assert 0.5 < np.median(sigma) < 1.5
    missing = {(r.configuration, r.leg) for r in value.rejected}
    present = set(zip(edges.configuration.tolist(), edges.leg.tolist(), strict=True))
    assert missing | present == {(k, leg) for k in range(6) for leg in range(6)}
    assert not missing & present


# The station


def rough_pose(seed, degrees=10.0, distance=0.1):
    """FRONT moved by a turn and a shift of given sizes in random directions."""
    rng = np.random.default_rng(seed)
    turn, shift = rng.normal(size=(2, 3))
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    shift *= distance / np.linalg.norm(shift)
    return inverse(inverse(FRONT) @ pose(rotation(turn), shift))


def test_an_image_edge_is_evidence_for_one_of_two_legs_behind_each_other():
    """Leg 1 moved to where leg 0 is seen, further from the camera: their edges coincide."""
    view = view_of(images()[:2])
    apart = view.legs(np.arange(2))
    a, b = apart.a.copy(), apart.b.copy()
    eye = inverse(FRONT)[:3, 3]
    a[:, 1], b[:, 1] = (eye + 1.02 * (end[:, 0] - eye) for end in (a, b))
    behind = replace(view, guessed=replace(apart, a=a, b=b, u=(b - a) / norm(b - a))[None])
    before, after = (
        pose_likelihood.coinciding_edges(v, FRONT[None], np.arange(2), 8).reshape(2, -1, 8)
        for v in (replace(view, guessed=apart[None]), behind)
    )
    leg = view.tubes.leg
    assert np.median(before[:, np.isin(leg, [0, 1])]) == 1
    assert np.mean(after[:, np.isin(leg, [0, 1])] == 2) > 0.8
    assert np.array_equal(after[:, leg > 1], before[:, leg > 1])


def test_a_leg_close_to_the_camera_counts_no_longer_than_the_image():
    """Its silhouette is mostly outside; the points inside stand for what may be inside."""
    view, rng = view_of(images()[:1]), np.random.default_rng(0)
    # cameras among the legs
    eye = rng.uniform((-0.3, -0.3, 0.0), (0.3, 0.3, 0.3), (300, 3))
    turn = rotation(rng.normal(size=(300, 3)))
    among = pose(turn, -(turn @ eye[..., None])[..., 0])
    found = pose_likelihood.distances_under(view, among, np.zeros(1, dtype=int), 8)
    diagonal = np.hypot(*view.camera.image_size) / view.tables.scale
    assert found.length.max() == pytest.approx(diagonal / 7)


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def view_of(pictures, mechanism=None, in_view=None):
    mechanism = mechanism or machine()
    in_view = poses() if in_view is None else in_view
    readings = machine().inverse(in_view)
    names = np.arange(len(pictures))
    tables = distance_tables(pictures)
    return StationView(mechanism, camera_of(), names, readings, in_view, tables)


def test_few_images_are_tested_against_earlier_readings():
    """Six configurations determine badly how well other readings fit by chance; thirty determine
    it better, and images under each other's names are refused as before.
    """
    rng, spread = np.random.default_rng(3), np.repeat([0.15, 0.03], 3)
    elsewhere = [perturb(poses(), rng.normal(size=(6, 6)) * spread) for _ in range(4)]
    earlier = machine().inverse(np.concatenate(elsewhere))

    def localized(names, earlier_joints):
        view = replace(view_of([images()[k] for k in names]), earlier_joints=earlier_joints)
        return find_station(view, rough_pose(1), np.random.default_rng(0))

    few, more, exchanged = (
        localized(*one) for one in (((0, 1, 2), None), ((0, 1, 2), earlier), ((1, 2, 0), earlier))
    )
    assert few.good
    assert more.good
    assert more.p_value < 0.1 * few.p_value
    assert not exchanged.good


def test_images_are_asked_under_each_name_as_if_they_bore_it():
    view, names = view_of(images()), np.array([4, 0, 3])
    fits = pose_likelihood.log_likelihood_by_name(view, FRONT, names)
    every = np.arange(len(images()))
    own = pose_likelihood.distances_under(view, FRONT[None], every, 8)
    mixture = pose_likelihood.mixture_of(own)
    for name, fit in zip(names, fits.T, strict=True):
        named = replace(view, configuration=np.full(len(every), name))
        count = pose_likelihood.distances_under(named, FRONT[None], every, 8).log_likelihood(
            mixture
        )
        np.testing.assert_allclose(fit, pose_likelihood.by_image(count, len(every))[0], rtol=1e-5)
        assert fit.argmax() == name


def inconsistent_poses(T_camera_base):
    """Pixels by which leg points of all configurations are off, the median."""
    ends = machine().base_centers(), machine().platform_centers()
    base = np.broadcast_to(ends[0], (6, 6, 3))
    platform = ends[1] @ poses()[:, :3, :3].swapaxes(1, 2) + poses()[:, None, :3, 3]
    points = np.concatenate([base, platform]).reshape(-1, 3)

    def visible(T):
        return camera_of().project(points @ T[:3, :3].T + T[:3, 3])

    return np.median(np.linalg.norm(visible(T_camera_base) - visible(FRONT), axis=1))


def often(*values):
    """Another draw of a test above: a search of a second or more."""
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("seed", "given", "count"),
    [(0, True, 3), (1, True, 6), (0, False, 3), often(0, True, 6), often(1, True, 3),
     *(often(seed, True, count) for seed in (2, 3) for count in (3, 6)), often(0, False, 6),
     *(often(seed, False, count) for seed in (1, 2, 3) for count in (3, 6))],
)  # fmt: skip
def test_the_station_is_found_from_ten_degrees_and_ten_centimetres_or_from_nothing(
    seed, given, count
):
    """To a few pixels, within the reach of the search for legs that follows.

    Tables are of reduced images; a table's pixel is 2.5 of the image's.
    """
    rough = rough_pose(seed)
    view = view_of(images()[:count])
    localization = find_station(view, rough if given else None, np.random.default_rng(seed))
    assert localization.good
    assert localization.score < 0.3
    assert inconsistent_poses(rough) > 30
    assert inconsistent_poses(localization.T_camera_base) < 5
    off = pose_difference(localization.T_camera_base, FRONT)
    assert np.degrees(np.linalg.norm(off[:3])) < (2.0 if count == 3 else 1.5)
    assert np.linalg.norm(off[3:]) < 0.015


@pytest.mark.parametrize("turn", [often(90), often(180), 270])
def test_turned_images_are_found_from_nothing(turn):
    """A camera rotated about its line of sight: the same pixels in another order."""
    turned = pose(rotation(np.array([0.0, 0.0, np.radians(turn)])), np.zeros(3))
    cosine, sine = np.round([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    camera = camera_of()
    fx, fy, cx, cy = camera.parameters[:4]
    width, height = camera.image_size
    middle = np.array([cx - (width - 1) / 2, cy - (height - 1) / 2])
    if sine:
        fx, fy, width, height = fy, fx, height, width
    middle = np.array([[cosine, -sine], [sine, cosine]]) @ middle
    middle += np.array([width - 1, height - 1]) / 2
    parameters = np.concatenate([[fx, fy], middle, 0 * camera.parameters[4:]])
    pictures = [np.ascontiguousarray(np.rot90(image, -turn // 90)) for image in images()]
    view = replace(
        view_of(images()),
        camera=replace(camera, image_size=(width, height), parameters=parameters),
        tables=distance_tables(pictures),
    )
    localization = find_station(view, None, np.random.default_rng(0))
    assert localization.good
    assert inconsistent_poses(inverse(turned) @ localization.T_camera_base) < 5


def test_one_image_gives_a_pose_but_does_not_identify_the_machine():
    """From one image the pose is right; no other image confirms it."""
    localization = find_station(view_of(images()[:1]), None, np.random.default_rng(0))
    assert inconsistent_poses(localization.T_camera_base) < 5
    assert not localization.good


@pytest.mark.parametrize("seed", [2, *(often(seed) for seed in (0, 1, 3))])
def test_the_station_is_found_from_thirty_degrees_and_thirty_centimetres(seed):
    """Though images confirm a pose beside the right one as well."""
    rough = rough_pose(seed, 30.0, 0.3)
    localization = find_station(view_of(images()), rough, np.random.default_rng(seed))
    assert localization.good
    assert inconsistent_poses(localization.T_camera_base) < 5


@pytest.mark.parametrize(("degrees", "distance", "far"), [(5.0, 0.05, False), (14.0, 0.14, True)])
def test_a_search_goes_further_only_where_the_pose_is_not_near(monkeypatch, degrees, distance, far):
    """A confirmed pose is not the station's if it is further away than the search: so near to a
    wrong rough pose nothing is found by chance.
    """
    searched, searching = [], station_localization._random_search

    def noted(view, values, *rest):
        searched.append(values.nearness.tried)
        return searching(view, values, *rest)

    monkeypatch.setattr(station_localization, "_random_search", noted)
    rough = rough_pose(3, degrees, distance)
    localization = find_station(view_of(images()), rough, np.random.default_rng(3))
    assert localization.sure
    assert inconsistent_poses(localization.T_camera_base) < 5
    assert searched[0] == LOCALIZATION_OPTIONS.near.tried
    assert (LOCALIZATION_OPTIONS.far.tried in searched) == far


def test_a_near_pose_is_near_by_turn_and_shift_together():
    """Its six deviations' squares are one on average; turned and shifted by a deviation along each
    axis is the limit."""
    step = LOCALIZATION_OPTIONS.near.spread * (1 - 1e-9)
    for size, near in ((1.0, True), (1.001, False)):
        other = inverse(inverse(FRONT) @ pose(rotation(size * step[:3]), size * step[3:]))
        assert LOCALIZATION_OPTIONS.near.reaches(FRONT, other) == near
        assert LOCALIZATION_OPTIONS.near.reaches(other, FRONT) == near


def test_edges_behind_the_camera_count_as_not_found():
    """A camera that has no leg before it, or half of them, does not fit the better for it."""
    view = view_of(images())
    every = np.arange(len(images()))
    turned = pose(rotation(np.array([0.0, np.pi, 0.0])), np.zeros(3)) @ FRONT
    among = FRONT.copy()
    among[2, 3] = 0.0
    right, behind, half = score(view, np.stack([FRONT, turned, among]), every, 8)
    assert right < 0.3
    assert behind == 1
    assert half > 0.8


def test_a_nominal_model_that_is_2_mm_wrong_is_localized():
    view = view_of(images(), redrawn(5, 0.002))
    localization = find_station(view, rough_pose(9), np.random.default_rng(9))
    assert localization.good
    assert inconsistent_poses(localization.T_camera_base) < 6


def test_the_same_generator_gives_the_same_pose():
    view = view_of(images()[:2])
    twice = [find_station(view, rough_pose(0), np.random.default_rng(4)) for _ in range(2)]
    np.testing.assert_array_equal(twice[0].T_camera_base, twice[1].T_camera_base)


def blank(_rng):
    return np.full((480, 640), 120, np.uint8)


def noisy(rng):
    return np.clip(120 + 10 * rng.normal(size=(480, 640)), 0, 255).astype(np.uint8)


def texture(rng):
    """Gravel: edges of every direction everywhere, so that any leg lies near some."""
    return np.clip(120 + 40 * rng.normal(size=(480, 640)), 0, 255).astype(np.uint8)


def clouds(rng):
    field = gaussian_filter(rng.normal(size=(480, 640)), 6) * 2000 + 120
    return field.clip(0, 255).astype(np.uint8)


def sticks(rng):
    """Tubes like the machine's, thrown anywhere."""
    thrown = perturb(np.eye(4), rng.normal(size=(6, 6)) * np.repeat([1.0, 0.15], 3))
    tubes = [t for T in thrown for t in tubes_at(machine(), T)]
    return draw([t for k, t in enumerate(tubes) if k % 7 == 0])[0]


@pytest.mark.parametrize(
    ("scene", "count"),
    [(sticks, 2),
     *(often(scene, 2) for scene in (blank, noisy, texture, clouds)),
     *(often(scene, 6) for scene in (blank, noisy, texture, clouds, sticks))],
)  # fmt: skip
def test_images_of_something_else_are_not_localized(scene, count):
    rng = np.random.default_rng(1)
    view = view_of([scene(rng) for _ in range(count)])
    for start in (rough_pose(0), None):
        assert not find_station(view, start, np.random.default_rng(0)).good


def test_images_of_other_configurations_are_not_localized():
    """Each image under its neighbour's name."""
    view = view_of([*images()[1:], images()[0]])
    for seed in range(2):
        assert not find_station(view, rough_pose(seed), np.random.default_rng(seed)).good


# Distance tables

DIRECTIONS = DISTANCE_TABLE_OPTIONS.directions


@pytest.mark.parametrize("at_once", [pose_likelihood.LIKELIHOOD_OPTIONS.points_at_once, 500])
def test_places_that_are_only_weighed_find_what_those_find_that_descend(at_once):
    view = view_of(images())
    view = replace(view, options=replace(view.options, points_at_once=at_once))
    at = np.stack([rough_pose(seed) for seed in range(5)])
    every = np.arange(len(view.configuration))
    weighed = pose_likelihood.distances_under(view, at, every, 6)
    for one, other in zip(
        weighed, pose_likelihood.linearize_distances(view, at, every, 6).distances, strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_directions_are_of_lines_not_of_arrows():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False) + 1e-3
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    number = direction_of(normal, DIRECTIONS)
    np.testing.assert_array_equal(number, direction_of(-normal, DIRECTIONS))
    np.testing.assert_array_equal(np.unique(number), np.arange(DIRECTIONS))
    assert np.all(np.diff(number[:100]) >= 0)


def test_tables_of_a_direction_are_worked_out_when_it_is_looked_for():
    image = np.full((480, 640), 200, np.uint8)
    image[:, :320] = 40
    tables = distance_tables([image])
    assert not tables.tables.ready.any()
    pixel, one = np.array([[200.0, 240.0]]), np.array([3])
    distance, _ = tables.look_up(one, pixel, np.array(0))
    np.testing.assert_array_equal(np.flatnonzero(tables.tables.ready), one)
    chance = tables.by_chance(np.array([5]), distance)
    np.testing.assert_array_equal(np.flatnonzero(tables.tables.ready), [3, 5])
    # independent of earlier searches
    tables.tables.get_ready(np.arange(DIRECTIONS))
    assert tables.look_up(one, pixel, np.array(0))[0] == distance
    assert tables.by_chance(np.array([5]), distance) == chance
    np.testing.assert_allclose(
        tables.tables.chance.sum(axis=1) * DISTANCE_TABLE_OPTIONS.bin_width, 1.0, rtol=1e-5
    )


def test_tables_hold_the_distance_to_an_edge_of_that_direction():
    """An image with a dark half: its upright border is at 320, and there is no level one."""
    image = np.full((480, 640), 200, np.uint8)
    image[:, :320] = 40
    tables = distance_tables([image])
    upright, level = direction_of(np.array([[1.0, 0.0], [0.0, 1.0]]), DIRECTIONS)
    x = np.array([20.0, 200.0, 319.5, 400.0, 620.0])
    pixel = np.stack([x, np.full(5, 240.0)], axis=-1)
    distance, inside = tables.look_up(upright, pixel, np.array(0))
    assert inside.all()
    # the distance transform counts a step along a row as 0.955; Canny and rounding have a table's
    # pixel each
    allowed = {"rtol": 0.05, "atol": 2 * tables.scale}
    np.testing.assert_allclose(distance * tables.scale, np.abs(x - 319.5), **allowed)
    right = np.array([1.0, 0.0])
    smooth, slope, _ = tables.look_along(upright, pixel, right, np.array(0))
    np.testing.assert_allclose(smooth * tables.scale, np.abs(x - 319.5), **allowed)
    np.testing.assert_allclose(slope[[0, 1, 3]] * tables.scale, [-1, -1, 1], rtol=0.05)
    assert tables.look_up(level, pixel, np.array(0))[0].min() > 100


def test_outside_the_picture_and_without_an_image_nothing_is_inside():
    tables = distance_tables([blank(None)])
    pixel = np.array([[-5.0, 10.0], [700.0, 10.0], [10.0, 481.0], [np.nan, np.nan]])
    zero = np.zeros(4, dtype=int)
    assert not tables.look_up(zero, pixel, zero)[-1].any()
    assert not tables.look_along(zero, pixel, np.zeros((4, 2)), zero)[-1].any()


def test_edges_that_never_move_are_left_out_where_images_can_be_compared():
    """A shelf in all of five images is background; in two images it cannot be separated."""
    shelf = np.full((480, 640), 180, np.uint8)
    shelf[100:140] = 60
    pictures = []
    for k in range(5):
        picture = shelf.copy()
        picture[200:400, 100 + 60 * k : 130 + 60 * k] = 20
        pictures.append(picture)
    level = direction_of(np.array([0.0, 1.0]), DIRECTIONS)
    on_shelf, number = np.array([[600.0, 100.0]]), np.zeros(1, dtype=int)
    few, many = distance_tables(pictures[:2]), distance_tables(pictures)
    assert few.look_up(level, on_shelf, number)[0] < 2
    assert many.look_up(level, on_shelf, number)[0] > 20
    upright = direction_of(np.array([1.0, 0.0]), DIRECTIONS)
    assert many.look_up(upright, np.array([[100.0, 300.0]]), number)[0] < 2


def test_a_shadow_darkens_and_is_left_out_beside_what_casts_it():
    """A bright bar that moves before a grey wall, and its shadow below."""
    pictures = []
    for k in range(5):
        picture = np.full((480, 640), 120, np.uint8)
        picture[100:120, 60 + 90 * k : 140 + 90 * k] = 240
        picture[300:320, 60 + 90 * k : 140 + 90 * k] = 60
        pictures.append(picture)
    tables = distance_tables(pictures)
    pixel = np.array([[100.0, 110.0], [100.0, 310.0], [100.0, 200.0], [-5.0, 110.0]])
    for in_view, turn in ((tables, 1), (tables.mirrored(), -1)):
        at = pixel if turn > 0 else pixel * (-1, 1) + (639, 0)
        sign, inside = in_view.brighter(at, np.zeros(4, dtype=int))
        assert sign.tolist() == [1, -1, 0, 0]
        assert inside.tolist() == [True, True, True, False]
    places = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    assert without_shadows(places, np.array([-1.0, 0.9, 0.0])).tolist() == [1, 2]
    assert without_shadows(places, np.array([-1.0, 0.2, -0.9])).tolist() == [0, 1, 2]
    places[1] = pose(rotation(np.array([0.0, 0.0, 1.0])), np.zeros(3))
    assert without_shadows(places, np.array([-1.0, 0.9, 0.0])).tolist() == [0, 1, 2]


@pytest.mark.slow
def test_a_place_that_half_of_the_images_miss_is_asked_about_again(tmp_path, monkeypatch):
    """Of three equal legs a search in five images ends beside the pose that all ten lead to: it is
    accepted once the other images are tested at that pose, and not before.
    """
    settings = Settings(stations=1, configurations=10)
    folder = tmp_path / "session"
    simulate_session(folder, load_mechanism("3-rps"), camera_of_size((640, 480)), settings, seed=5)
    session = load_session(folder)
    visible = read_images(session)
    (view,) = localize_by_legs(
        session, visible, platform_poses(session), [np.random.default_rng(0)]
    ).views
    localization = find_station(view, None, np.random.default_rng(1))
    assert localization.good
    # By the nominal model it is likelier than the true pose, which is 0.2 m away, and to which
    # `calibrate` comes back.
    true = load_truth(folder, session.machine).T_camera_base
    at_truth = station_localization.refine_ml(view, true, view.few(10), 8, 8)[1]
    assert localization.log_likelihood_ratio > at_truth[0]
    monkeypatch.setattr(station_localization, "_second_search", lambda *_: 1.0)
    assert not find_station(view, None, np.random.default_rng(1)).good
