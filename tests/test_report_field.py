"""Residuals over the image: shifts from edges and corners, each across its direction."""

import numpy as np
import pytest

from pkmcal.report import correlation_plot, field
from pkmcal.report.corners import BoardCorners
from pkmcal.report.field import Offsets
from test_report_case import OUTWARD, Case, make_case


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


def drawn_field(case: Case, shift_at, noise, n=6000):
    """The first station's cells from n edges with ``shift_at`` pixels across themselves."""
    rng = np.random.default_rng(5)
    pixel = rng.uniform(0, 1, (n, 2)) * [319, 239]
    angle = rng.uniform(0, np.pi, n)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    value = np.sum(direction * shift_at(pixel), axis=-1) + noise * rng.normal(size=n)
    zero = np.zeros(n, dtype=int)
    offsets = Offsets(zero, zero, np.arange(n), pixel, direction, value)
    (one,) = field.fields(case.session, offsets, ())
    return one


def test_cells_have_the_shift_that_their_edges_agree_on(case):
    def lens(pixel):
        away = pixel - [160.2, 119.1]
        return 2e-7 * np.sum(away**2, axis=-1, keepdims=True) * away

    one = drawn_field(case, lens, noise=0.01)
    assert one.middle == (160.2, 119.1)
    place = np.array([cell.at for cell in one.cells])
    shift = np.array([cell.displacement for cell in one.cells])
    # half a cell of 320 / 14 px: the lens moves the corner by 1.6 px
    np.testing.assert_allclose(shift, lens(place), atol=0.12)
    far = np.linalg.norm(place - one.middle, axis=1) > 60
    assert all(not cell.dashed for cell, away in zip(one.cells, far, strict=True) if away)


def test_noise_alone_stands_out_in_one_cell_of_a_hundred(case):
    one = drawn_field(case, np.zeros_like, noise=0.2, n=20000)
    loud = sum(not cell.dashed for cell in one.cells)
    assert len(one.cells) > 130
    assert loud <= 6  # 1.5 expected; more than six by chance once in a thousand


def test_of_parallel_edges_only_what_is_across_them_is_shown(case):
    rng = np.random.default_rng(2)
    n = 4000
    pixel = rng.uniform(0, 1, (n, 2)) * [319, 239]
    direction = np.tile([1.0, 0.0], (n, 1))
    zero = np.zeros(n, dtype=int)
    value = 0.3 + 0.01 * rng.normal(size=n)
    offsets = Offsets(zero, zero, np.arange(n), pixel, direction, value)
    (one,) = field.fields(case.session, offsets, ())
    shift = np.array([cell.displacement for cell in one.cells])
    np.testing.assert_allclose(shift, np.tile([0.3, 0.0], (len(shift), 1)), atol=0.02)


def test_arrows_lead_to_images_on_the_page_only(case):
    names = [f"image:{case.session.stations[0].name}/{name}" for name in ("c0", "c1")]
    n = 4000
    rng = np.random.default_rng(4)
    pixel = rng.uniform(0, 1, (n, 2)) * [319, 239]
    direction = np.tile([1.0, 0.0], (n, 1))
    row = np.arange(n) % 2
    # the residuals of the second configuration are the larger ones
    offsets = Offsets(np.zeros(n, dtype=int), row, np.arange(n), pixel, direction, 0.1 + 0.2 * row)
    keys_of = {}
    for keys in (names, names[:1], []):
        (one,) = field.fields(case.session, offsets, keys)
        keys_of[len(keys)] = {cell.key for cell in one.cells}
    assert keys_of == {2: {names[1]}, 1: {names[0]}, 0: {""}}


@pytest.mark.parametrize("turns", range(4))
def test_the_scale_lies_at_the_lower_left_of_the_upright_image(turns):
    size = (320, 240)
    arrow = field.scale_arrow(size, 100.0, turns)
    turn = field.upright_turn(turns)
    width, height = size[::-1] if turns % 2 else size
    middle = np.array(size) / 2
    x, y = turn @ (np.array(arrow.at) - middle) + np.array([width, height]) / 2
    right, down = turn @ np.array(arrow.displacement)
    assert 0 < x < 0.1 * width
    assert 0.9 * height < y < height
    assert right > 0
    assert abs(down) < 1e-9


def test_edges_are_off_by_what_they_were_shifted(case):
    none, no_pixel = np.zeros(0, dtype=int), np.zeros((0, 2))
    corners = BoardCorners(none, none, none, none, no_pixel, no_pixel, none.astype(bool))
    count = field.field_offsets(case.session, case.observation.edges, case.estimate, corners)
    inliers = int(np.sum(case.estimate.edge_weights >= 0.5))
    assert len(count.value) == inliers * len(field.FIELD_EDGE_FRACTIONS)
    # the camera's own constant shift is taken out; the two sides of a leg lie off in opposite ways
    side = case.observation.edges.side[count.thing]
    np.testing.assert_allclose(count.value, np.where(side == 0, OUTWARD, -OUTWARD), atol=2e-3)


def test_correlations_are_those_of_the_covariance(case):
    part = correlation_plot.section(case.estimate)
    assert part is not None
    cells = next(mark for mark in part.blocks[0].marks if mark.mark == "cells")
    rho = np.array([[value or 0.0 for value in row] for row in cells.values])
    covariance = case.estimate.covariance
    free = np.flatnonzero(np.diag(covariance) > 0)
    sigma = np.sqrt(np.diag(covariance)[free])
    expected = covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
    empty = np.abs(expected) < correlation_plot.LEAST_CORRELATION
    np.testing.assert_allclose(rho, np.where(empty, 0.0, expected), atol=0.005)
    table = case.estimate.machine.parameters
    assert cells.columns == cells.rows == tuple(table.in_words(table.names[k]) for k in free)
