"""Plots of the reports: axes that cannot lose their labels, and values against the data."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkmcal.api.study import study
from pkmcal.calibration.discrepancy_basis import BedSurface
from pkmcal.identify.parameter_estimates import parameter_estimates
from pkmcal.outcome import Verdict
from pkmcal.outcome.blocks.plot import (
    LEAST_LOG_TICKS,
    LEAST_TICKS,
    Plot,
    linear_axis,
    linear_ticks,
    log_axis,
    panels,
)
from pkmcal.report import bed, camera_plots, charts, residuals
from pkmcal.report.calibration import report_of
from pkmcal.report.parameter_changes import changes
from pkmcal.web.report_page import report_page
from pkmcal.wording import MINUS_SIGN
from test_report_case import Case, calibration, make_case
from test_show import acting, browse


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


def mark_of(plot: Plot, kind: str):
    """The only mark of a kind."""
    (mark,) = (mark for mark in plot.marks if mark.mark == kind)
    return mark


def plots_of(part) -> list[Plot]:
    """Plots of a section, also those in panels."""
    return [
        plot
        for block in part.blocks
        for plot in (block.plots if block.kind == "panels" else [block])
        if plot.kind == "plot"
    ]


# ------------------------------------------------------------------ axes

SIZES = st.floats(-9, 9).map(lambda power: 10.0**power)


def ticks_stand(axis, least) -> None:
    """At least so many labels, all different, within the limits, each the number at its place."""
    low, high = axis.limits
    labels = [tick.label for tick in axis.ticks]
    assert len(labels) >= least
    assert len(labels) <= 12
    assert len(set(labels)) == len(labels)
    for tick in axis.ticks:
        assert low - 1e-9 * (high - low) <= tick.at <= high + 1e-9 * (high - low)


@given(st.floats(-1e6, 1e6), SIZES)
def test_a_linear_axis_has_four_labels(first, size):
    axis = linear_axis("", (first, first + size))
    ticks_stand(axis, LEAST_TICKS)
    size = axis.limits[1] - axis.limits[0]
    for tick in axis.ticks:
        value = float(tick.label.replace(MINUS_SIGN, "-"))
        assert value == pytest.approx(tick.at, abs=1e-6 * size)


@given(SIZES, st.floats(1, 1e8))
def test_a_logarithmic_axis_has_three_labels(first, ratio):
    ticks_stand(log_axis("", (first, first * ratio)), LEAST_LOG_TICKS)


def test_an_axis_holds_its_values_and_its_zero():
    axis = linear_axis("mm", [0.3, float("nan"), 0.7], zero=True)
    assert axis.limits[0] == 0
    assert axis.limits[1] > 0.7
    assert linear_axis("mm", [-3.0, -1.0], zero=True).limits[1] == 0
    assert linear_axis("mm", []).limits[0] < 0 < 1 < linear_axis("mm", []).limits[1]
    assert [tick.label for tick in log_axis("", (0.076, 0.135)).ticks][:2] == ["0.08", "0.09"]
    assert [tick.label for tick in log_axis("", (1e-6, 1.0)).ticks][:1] == ["10⁻⁶"]
    assert [tick.at for tick in linear_ticks(-2.2, 2.2)] == [-2, -1, 0, 1, 2]


# ------------------------------------------------------------------ charts


@pytest.mark.parametrize("values", [[], [0.0], [0.0, 0.0], [float("nan")]])
def test_axes_of_nothing_but_zeros_have_labels(values):
    zero = linear_axis("mm", values, zero=True)
    assert zero.limits == (0.0, 1.0)
    for axis in (zero, linear_axis("mm", values), log_axis("mm", values)):
        low, high = axis.limits
        assert len(axis.ticks) >= LEAST_LOG_TICKS
        assert all(low <= tick.at <= high for tick in axis.ticks)


def test_a_box_holds_the_quantiles_of_the_finite_values():
    values = np.concatenate([np.arange(101.0), [np.nan]])
    box = charts.box("leg 1", values, "mm", 0)
    assert box.quantiles == (5, 25, 50, 75, 95)
    assert "median +50 mm" in box.tip
    assert box.tip.endswith("101 values")
    assert charts.box("leg 1", np.array([np.nan]), "mm", 0) is None


def test_one_bad_group_does_not_flatten_the_others():
    rng = np.random.default_rng(0)
    boxes = [charts.box(f"{k}", rng.normal(size=100), "σ", 2) for k in range(5)]
    bad = charts.box("bad", 1e3 * rng.normal(size=100), "σ", 2)
    plot = charts.row_plot("name", "Title", "σ", [*boxes, bad, None], "alt", charts.NORMAL_90)
    low, high = plot.x.limits
    assert -low == high < 10
    assert plot.y.categories == ("0", "1", "2", "3", "4", "bad")
    assert charts.row_plot("name", "Title", "σ", [None], "alt") is None
    assert panels(None) == ()


# ------------------------------------------------------------------ of a calibration


def test_every_plot_of_a_report_can_be_read_without_seeing_it(case):
    """A description, labels on each axis of numbers, names that differ, and no values but finite
    ones, which JSON has.
    """
    verdict = Verdict(True, "Fine.")
    parts = report_of(calibration(case.session, case.observation, case.estimate, verdict)).parts
    plots = [plot for part in parts for plot in plots_of(part)]
    assert len({plot.name for plot in plots}) == len(plots) >= 12
    for plot in plots:
        assert len(plot.alt) > 20
        for axis in (plot.x, plot.y):
            assert axis.categories if axis.scale == "categories" else len(axis.ticks) >= 3
        names = [mark.name for mark in plot.marks if getattr(mark, "name", "")]
        assert len(set(names)) == len(names)
        for mark in plot.marks:
            for point in mark.points if mark.mark in ("dots", "bars") else ():
                for value, axis in ((point.x, plot.x), (point.y, plot.y)):
                    assert (
                        value in axis.categories if isinstance(value, str) else math.isfinite(value)
                    )


def test_residuals_are_grouped_by_leg(case):
    estimate, edges = case.estimate, case.observation.edges
    plot = residuals.by_leg(case.session, edges, estimate)
    boxes = mark_of(plot, "boxes").boxes
    assert [box.key for box in boxes] == [f"leg:{j + 1}" for j in range(6)]
    mine = estimate.edge_residuals[edges.leg == 3]
    assert boxes[3].quantiles[2] == pytest.approx(np.median(mine), abs=1e-5)
    k = np.flatnonzero(edges.leg == 3)[np.argmax(np.linalg.norm(mine, axis=1))]
    image = (
        f"{case.session.station_names[edges.station[k]]}/"
        f"{case.session.configurations[edges.configuration[k]]}"
    )
    assert boxes[3].tip.endswith(f"the largest in {image}")


def test_a_noisy_configuration_stands_out(case):
    edges, white = case.observation.edges, case.estimate.edge_residuals.copy()
    white[:] = np.random.default_rng(0).normal(size=white.shape)
    white[edges.configuration == 2] *= 4
    estimate = replace(case.estimate, edge_residuals=white)
    part = residuals.section(case.session, edges, estimate, np.zeros(len(edges)))
    (plot,) = (plot for plot in plots_of(part) if plot.name == "edges-by-configuration")
    bars = mark_of(plot, "bars").points
    assert [bar.colour for bar in bars] == ["quiet", "quiet", None, "quiet", "quiet"]
    assert bars[2].key == "configuration:c2"
    mine, weights = white[edges.configuration == 2], estimate.edge_weights[edges.configuration == 2]
    level = np.sqrt(np.sum(weights[:, None] * mine**2) / (2 * weights.sum()))
    assert bars[2].y == pytest.approx(level, rel=1e-5)
    assert bars[2].high < bars[2].y


def test_the_histogram_counts_every_residual():
    white = np.array([[-7.0, 0.1], [0.2, 9.0], [np.nan, 1.3]])
    plot = residuals.histogram(white)
    bars = mark_of(plot, "bars").points
    assert sum(bar.y for bar in bars) == 5
    assert (bars[0].y, bars[-1].y) == (1, 1)
    assert "or beyond" in bars[0].tip
    assert residuals.histogram(np.zeros((0, 2))) is None


def test_changes_are_in_tolerances_by_leg(case):
    e, nominal = case.estimate, case.session.machine
    estimates = parameter_estimates(nominal.values, e.machine, e.covariance, e.data_share)
    (block,) = changes(estimates)
    assert [plot.title for plot in block.plots] == [f"Leg {k + 1}" for k in range(6)]
    assert len({plot.x for plot in block.plots}) == 1  # one scale, to be compared
    points = {
        (plot.name, point.y): point
        for plot in block.plots
        for point in mark_of(plot, "dots").points
    }
    k = nominal.parameters.index("legs[2].base.center.x")
    point = points["changes-2", "base centre x"]
    tolerance = nominal.parameters.tolerance[k]
    change, sigma = e.machine.values[k] - nominal.values[k], np.sqrt(e.covariance[k, k])
    assert point.x == pytest.approx(change / tolerance, rel=1e-5)
    assert point.high - point.low == pytest.approx(4 * sigma / tolerance, rel=1e-4)
    assert point.key == "leg:2"
    # leg 1 holds the frame
    assert ("changes-1", "base centre y") not in points


# ------------------------------------------------------------------ of other results


def test_a_bed_is_coloured_by_its_height():
    height = np.array([-2e-4, 1e-4, 1e-4])
    surface = BedSurface(np.arange(3), np.zeros(3), np.arange(3.0) / 10, height, np.full(3, 1e-5))
    plot = bed.surface_plot(SimpleNamespace(configurations=("a", "b", "c")), surface)
    dots = mark_of(plot, "dots").points
    assert [(dot.y, dot.value, dot.key) for dot in dots] == [
        (0, -0.2, "configuration:a"), (100, 0.1, "configuration:b"), (200, 0.1, "configuration:c"),
    ]  # fmt: skip
    assert "−0.200 ± 0.010 mm" in dots[0].tip
    assert plot.colours.limits == pytest.approx((-0.2, 0.2))
    assert plot.equal


@pytest.fixture(scope="module")
def camera():
    """A camera calibration of two views: corners in the left half, one rejected in each view."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (159, 239), (2, 40, 2))
    inliers = np.ones((2, 40), dtype=bool)
    inliers[:, 0] = False
    model = SimpleNamespace(
        image_size=(320, 240),
        model="pinhole",
        ray=lambda p: np.stack([(p[:, 0] - 160) / 300, (p[:, 1] - 120) / 300, np.ones(len(p))], -1),
    )
    candidates = (("pinhole", (), 0.9, 1.0), ("pinhole", ("k1",), 0.1, 0.12))
    return SimpleNamespace(
        camera=model,
        terms=("k1",),
        pixels=pixels,
        inliers=inliers,
        residuals=rng.normal(0, 0.1, (2, 40, 2)),
        views=("a.png", "b.png"),
        held_out=SimpleNamespace(by_view=np.array([0.1, 0.5])),
        compared=tuple(
            SimpleNamespace(model=name, terms=terms, rms=rms, left_out=left_out)
            for name, terms, rms, left_out in candidates
        ),
    )


def test_a_camera_shows_where_its_corners_are(camera):
    cells = mark_of(camera_plots.coverage_plot(camera), "cells")
    counts = np.array([[value or 0 for value in row] for row in cells.values])
    assert counts.sum() == camera.inliers.sum()
    assert counts[:, : counts.shape[1] // 2].sum() == counts.sum()
    angles = mark_of(camera_plots.angles_plot(camera), "bars")
    assert sum(bar.y for bar in angles.points) == camera.inliers.sum()
    largest = np.rad2deg(np.arctan(np.hypot(160, 120) / 300))
    assert angles.points[-1].x - angles.width < largest


def test_a_camera_compares_its_views_and_models(camera):
    bars = mark_of(camera_plots.views_plot(camera), "bars").points
    assert [(bar.x, bar.y, bar.colour) for bar in bars] == [
        ("a.png", 0.1, "quiet"), ("b.png", 0.5, "quiet"),
    ]  # fmt: skip
    plot = camera_plots.models_plot(camera)
    assert plot.y.categories == ("pinhole", "✓ pinhole k1")
    fitted, held_out = (mark.points for mark in plot.marks)
    assert [point.x for point in (*fitted, *held_out)] == [0.9, 0.1, 1.0, 0.12]
    one = SimpleNamespace(**{**vars(camera), "compared": camera.compared[:1]})
    assert camera_plots.models_plot(one) is None


def test_lines_of_a_study_join_numbers_only(one_process):
    """Three numbers on a scale are joined; of two names every combination is shown once."""
    result = study("3-rpr", ["configurations=4,5,6", "stations=1,2"], runs=4)
    part = result.outcome.parts[0]
    (plot,) = plots_of(part)
    assert plot.name == "by-configurations"
    assert [tick.at for tick in plot.x.ticks] == [4, 5, 6]
    lines = [mark.points for mark in plot.marks if mark.mark == "line"]
    dots = [mark for mark in plot.marks if mark.mark == "dots" and mark.symbol == "circle"]
    assert [mark.name for mark in dots] == ["stations 1", "stations 2"]
    for line, mark in zip(lines, dots, strict=True):
        assert line == tuple((point.x, point.y) for point in mark.points)
    values = {cell.position.value for cell in result.found}
    plotted = [point.y * 1e-3 for mark in dots for point in mark.points]
    np.testing.assert_allclose(sorted(plotted), sorted(values), rtol=1e-5)
    for point in dots[0].points:
        assert point.low < point.y < point.high


# ------------------------------------------------------------------ in a browser

POINT = """
const faults = [];
addEventListener("error", (event) => { if (event.message) faults.push(event.message); });
document.addEventListener("securitypolicyviolation", (event) => {
  faults.push(`blocked ${event.blockedURI} ${event.violatedDirective}`);
});
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
addEventListener("load", async () => {
  const out = document.documentElement.dataset, root = document.documentElement;
  for (const part of document.querySelectorAll("details")) part.open = true;
  await wait(500);
  const pictures = [...document.querySelectorAll(".plot .area > svg")];
  out.plots = pictures.length;
  out.described = pictures.every((svg) =>
    svg.getAttribute("role") === "img" && svg.getAttribute("aria-label").length > 20);
  const overlaps = (texts) => texts.some((a, k) => texts.slice(0, k).some((b) =>
    a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom));
  out.overlaps = pictures.filter((svg) => overlaps(
    [...svg.querySelectorAll("text")].filter((text) => text.textContent)
      .map((text) => text.getBoundingClientRect()))).map((svg) => svg.ariaLabel).join();
  const bar = document.querySelector('.plot rect[data-key="leg:3"]');
  const { left, right, top, bottom } = bar.getBoundingClientRect();
  const at = { clientX: (left + right) / 2, clientY: (top + bottom) / 2, bubbles: true,
               pointerType: "mouse" };
  bar.dispatchEvent(new PointerEvent("pointermove", at));
  bar.dispatchEvent(new PointerEvent("pointerover", at));
  out.tip = [...bar.ownerSVGElement.querySelectorAll('[aria-label="tip"] text')]
    .map((text) => text.textContent).join(" ");
  const lit = [...document.querySelectorAll(".plot .hovered")];
  out.lit = [...new Set(lit.map((element) => element.dataset.key))].join();
  out.others = new Set(lit.map((element) => element.ownerSVGElement)).size;
  out.overhang = root.scrollWidth - root.clientWidth;
  out.faults = faults.join("; ");
  out.done = "yes";
});
"""


def test_plots_are_drawn_on_a_phone(case, tmp_path):
    """Described, without labels over each other; a pointer shows a tooltip and, in all plots, what
    belongs to the same leg.
    """
    verdict = Verdict(True, "Fine.")
    outcome = report_of(calibration(case.session, case.observation, case.estimate, verdict))
    plots = [plot for part in outcome.parts for plot in plots_of(part)]
    file = tmp_path / "page.html"
    file.write_text(acting(report_page(outcome), POINT), encoding="utf-8")
    value = browse(file.as_uri(), tmp_path, 390, "--disable-gpu")
    assert value["faults"] == ""
    assert int(value["plots"]) == len(plots)
    assert value["described"] == "true"
    assert value["overlaps"] == ""
    assert "leg 3" in value["tip"].lower()
    assert value["lit"] == "leg:3"
    assert int(value["others"]) > 1
    assert value["overhang"] == "0"
