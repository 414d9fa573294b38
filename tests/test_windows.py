"""Images pass through in windows: bounded memory, and unchanged results."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import fields, replace
from threading import get_ident

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pkmcal.calibration import refinement
from pkmcal.calibration.localization import (
    SearchImages,
    localize_by_legs,
    platform_poses,
    read_images,
    suspect_stations,
)
from pkmcal.geometry.rigid import perturb
from pkmcal.observe import legs
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.image_batches import WINDOW_SIZE, Placed, WindowSize, windows
from pkmcal.observe.legs import measure, measure_stations, search, search_stations
from pkmcal.session.load import load_session
from test_observe_measure import taken
from test_observe_rendered_legs import FRONT, poses, redrawn

REPEATED = 3
"""Repetitions of the six rendered images."""


class Fresh(Sequence):
    """Images that are made when they are read; counts how many exist at a time."""

    def __init__(self, images):
        self.images, self.alive, self.most, self.reads = images, 0, 0, 0

    def __len__(self):
        return len(self.images)

    def __getitem__(self, index):
        image = self.images[index].view()  # an object of its own
        self.alive += 1
        self.reads += 1
        self.most = max(self.most, self.alive)
        weakref.finalize(image, self._gone)
        return image

    def _gone(self):
        self.alive -= 1


def many(most=WINDOW_SIZE.images, repeated=REPEATED):
    """Images in windows of ``most``, their platform poses, and their counter."""
    few = taken()
    rows = np.tile(np.arange(len(few.images)), repeated)
    fresh = Fresh([few.images[k] for k in rows])
    images = replace(few.select(rows), images=fresh, largest=WindowSize(most))
    return images, poses()[rows], fresh


LOOKS = {
    "search": lambda p, T: search(p, redrawn(0, 0.0005), FRONT, T),
    "measure": lambda p, T: measure(p, redrawn(0, 0.0005), FRONT, T),
    "refine": lambda p, T: measure(p, redrawn(0, 0.0005), FRONT, T, 0.7, refine_camera=True),
}


def same(edges, other):
    """Two measurements are equal."""
    assert edges.rejected == other.rejected
    for field in fields(other.edges):
        ours, theirs = (getattr(one.edges, field.name) for one in (edges, other))
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(edges.point_edge, other.point_edge)
    np.testing.assert_allclose(edges.points, other.points, atol=1e-9)
    np.testing.assert_allclose(edges.shift, other.shift, atol=1e-12)
    np.testing.assert_allclose(edges.blur, other.blur, atol=1e-12)


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
@pytest.mark.parametrize("window", [1, 4])
def test_no_more_than_a_window_is_decoded_at_a_time(look, window):
    images, visible, fresh = many(window)
    look(images, visible)
    assert fresh.most == window
    assert fresh.alive == 0
    # each once, and a window's for the blur where that is not known
    assert fresh.reads in (len(fresh), len(fresh) + window)


@pytest.mark.parametrize("name", ["search", "refine"])
def test_windows_change_nothing(name):
    images, visible, _ = many()
    whole = LOOKS[name](images, visible)
    value = LOOKS[name](many(4)[0], visible)
    same(value, whole)


def test_the_blur_of_many_images_is_estimated_from_one_batch():
    images, visible, _ = many(4)
    few = images.spread(4)
    assert few.tolist() == [0, 5, 11, 17]
    of_few = LOOKS["measure"](images.select(few), visible[few]).blur
    assert LOOKS["measure"](images, visible).blur == of_few


def test_large_images_have_small_windows():
    images, visible, _ = many()
    width, height = images.camera.image_size
    images = replace(images, largest=WindowSize(bytes=5 * width * height))
    placed = [Placed(images, FRONT, visible)]
    assert [len(window.images) for window in windows(placed)] == [5, 5, 5, 3]
    assert replace(images, largest=WindowSize(bytes=1)).window == 1  # one may take more


def stations(most):
    """Images in windows of ``most``, of one camera at three places, many at the first, from a
    little aside and more blurred at the second, and of another camera.
    """
    longer = replace(taken().camera, parameters=taken().camera.parameters * 1.0001)
    soft = taken([gaussian_filter(image, 0.6) for image in taken().images])
    first, visible, _ = many()
    made = [
        (replace(first, station=2), FRONT, visible),
        (replace(soft, station=5), perturb(FRONT, np.array([0, 0, 0, 5e-4, 0, 0])), poses()),
        (replace(taken(), station=7), FRONT, poses()),
        (replace(taken(), station=8, camera=longer), FRONT, poses()),
    ]
    size = WindowSize(most)
    return [Placed(replace(images, largest=size), T, at) for images, T, at in made]


@pytest.mark.parametrize(
    ("most", "expected"),
    [
        (32, [{2: 18, 5: 6, 7: 6}, {8: 6}]),
        (24, [{2: 18, 5: 6}, {7: 6}, {8: 6}]),
        (8, [{2: 8}, {2: 8}, {2: 2, 5: 6}, {7: 6}, {8: 6}]),
    ],
)
def test_stations_of_one_camera_share_windows(most, expected):
    counted = [np.unique(w.station, return_counts=True) for w in windows(stations(most))]
    assert [dict(zip(*map(np.ndarray.tolist, c), strict=True)) for c in counted] == expected


@pytest.mark.parametrize("other", [{"response": "srgb"}, {"binning": 2}])
def test_images_that_are_looked_at_otherwise_do_not(other):
    usual = Placed(taken(), FRONT, poses())
    others = replace(taken(), station=1, **other)
    case = [(w.response, w.binning) for w in windows([usual, usual._replace(images=others)])]
    assert case == [(p.response, p.binning) for p in (usual.images, others)]


@pytest.mark.parametrize("most", [8, 32])
@pytest.mark.parametrize("with_pose", [{}, {2: 0.7, 5: 0.55, 7: 0.8}], ids=["blur", "known"])
def test_together_stations_are_seen_as_each_alone(with_pose, most):
    drawn, placed = redrawn(0, 0.0005), stations(most)
    coarse, fine = search_stations(placed, drawn), measure_stations(placed, drawn, with_pose)
    for (p, T, in_view), whole, exact in zip(placed, coarse, fine, strict=True):
        same(whole, search(p, drawn, T, in_view))
        same(exact, measure(p, drawn, T, in_view, with_pose.get(p.station)))
        assert (exact.edges.station == p.station).all()
    entries = dict(zip((2, 5, 7, 8), (station_edges.blur for station_edges in fine), strict=True))
    assert entries.items() >= with_pose.items()
    assert with_pose or entries[5] > entries[7] + 0.1


def test_tables_look_at_each_image_once_and_share_their_memory():
    _, _, fresh = many()
    tables = distance_tables(fresh)
    assert (fresh.most, fresh.reads) == (2, len(fresh))
    some = tables.select(np.array([7, 2]))
    assert np.shares_memory(some.tables.picture, tables.tables.picture)
    place = np.array([100.0, 200.0])
    for k, own in enumerate((7, 2)):
        same = [
            t.look_up(np.array(3), place, np.array(n))[0] for t, n in ((some, k), (tables, own))
        ]
        assert same[0] == same[1]


@pytest.mark.parametrize(("enough", "each"), [(0.0, [1, 1, 1]), (np.inf, [3])])
def test_stations_are_looked_at_beside_one_another_or_together(enough, each):
    """With the same result, in their order."""
    images = [replace(many()[0], station=number) for number in range(3)]
    threads: set[int] = set()
    counts: list[int] = []

    def measure(some):
        threads.add(get_ident())
        counts.append(len(some))
        return [legs.joined_passes([], 0.5 + one.station, 0.0) for one in some]

    edges = refinement._search_pass(images, measure, enough)
    assert [in_view.blur for in_view in edges] == [0.5, 1.5, 2.5]
    assert (get_ident() in threads) == (enough > 0)
    assert counts == each
    assert refinement._search_pass([], measure, enough) == []


# ------------------------------------------------------------------ a session


@pytest.fixture(scope="module")
def session(demo):
    return load_session(demo.session)


def test_so_many_bytes_of_a_session_stay_decoded(session):
    sizes = [np.prod(station.camera.image_size) for station in session.stations]
    each = len(session.stations[0].images)
    images = read_images(session, sizes[0] * each + sizes[1])
    retained = [[p.images[k] is p.images[k] for k in range(len(p.images))] for p in images]
    assert retained[0] == [True] * each
    assert retained[1] == [True] + [False] * (each - 1)
    assert not any(retained[2])


def localized(session, numbers):
    """Stations localized in some of their images."""
    images = read_images(session)
    assert all(len(p.images) == 4 for p in images)
    rngs = np.random.default_rng(0).spawn(len(images))
    poses = platform_poses(session)
    return images, localize_by_legs(session, images, poses, rngs, numbers=numbers)


def test_the_machine_is_looked_for_in_some_of_many_images(session):
    """Spread over all of them, each under its own name."""
    few = SearchImages(most_at_station=3, fewest_at_station=2)
    images, results = localized(session, few)
    assert [numbers.tolist() for numbers in results.used] == [[0, 1, 3]] * len(images)
    for station in suspect_stations(session, images, results):
        names = [session.configurations[k] for k in station.view.configuration]
        assert [name in file for name, file in zip(names, station.files, strict=True)] == [True] * 3


def test_many_stations_share_the_images_that_are_looked_at(session):
    few = SearchImages(most=2 * len(session.stations), fewest_at_station=1)
    images, results = localized(session, few)
    assert [len(numbers) for numbers in results.used] == [2] * len(images)
