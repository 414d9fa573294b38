"""pkmcal as people use it in Python: what shows itself, tables, plots, results saved and loaded."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import is_dataclass, replace
from html import unescape
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import pkmcal
from faults import raises
from page_documents import page_document
from pkmcal.api.calibrate import CalibrationResult
from pkmcal.arrays import short_repr
from pkmcal.calibration import plots
from pkmcal.errors import InputError
from pkmcal.identify.tool import ToolAccuracy
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level
from pkmcal.placement.default_camera import camera_of_size, default_camera
from pkmcal.placement.edges import EdgeNoise
from pkmcal.planning.defaults import NOMINAL_EDGE_SIGMA, PLANNED_IMAGE_SIZE

ROOT = Path(__file__).parents[1]
LONGEST = 500
"""Characters of a repr; that of a table of parameters has twelve lines."""


@pytest.fixture(scope="module")
def result(calibrated) -> CalibrationResult:
    """Python's result of the calibration that these tests share."""
    return CalibrationResult.of(replace(calibrated, images={}))


@pytest.fixture(scope="module")
def planned(demo, quick_plans):
    return pkmcal.plan(demo.session, count=3)


@pytest.fixture(scope="module")
def loaded(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "out"
    assert result.save(folder) is None
    return pkmcal.load_result(folder)


# what is reachable


def test_everything_named_is_there_and_nothing_heavy_before_it_is_used():
    assert set(pkmcal.__all__) >= {
        "calibrate", "load_result", "load_session", "load_mechanism", "simulate", "plan", "study",
    }  # fmt: skip
    for name in pkmcal.__all__:
        assert getattr(pkmcal, name) is not None
    code = (
        "import sys, pkmcal; dir(pkmcal);"
        "print([m for m in ('numpy', 'cv2', 'scipy', 'matplotlib', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# what shows itself


def objects_of(value, name, depth, in_view):
    """pkmcal's objects that a person comes across behind a name."""
    yield name, value
    for attribute in dir(value):
        if depth and not attribute.startswith("_") and is_dataclass(value):
            other = getattr(value, attribute)
            inside = type(other).__module__.startswith("pkmcal") and not callable(other)
            if inside and type(other) not in in_view:
                in_view.add(type(other))
                yield from objects_of(other, f"{name}.{attribute}", depth - 1, in_view)


def test_reprs_are_short(result, loaded, planned):
    tool = result.tool_error(result.estimate.state.T_base_platform)
    in_view = set()
    for name, value in {
        "result": result, "loaded": loaded, "session": result.session, "machine": result.machine,
        "camera": result.session.stations[0].camera, "tool": tool, "plan": planned,
    }.items():  # fmt: skip
        for path, item in objects_of(value, name, 3, in_view):
            most = 1200 if path.endswith(".parameters") else LONGEST
            assert len(repr(item)) <= most, path
    assert len(in_view) > 20
    assert repr(result.machine) == (
        "<Machine gough-stewart: spatial, 6 legs, 6 readings, 60 parameters>"
    )
    camera = repr(result.session.stations[0].camera)
    assert camera.startswith("<Pinhole 480 × 360: focal.x 423, focal.y 423.6, center.x 241.")
    assert repr(result.session).startswith("<Session session: gough-stewart, ")
    assert repr(result).startswith("<Calibration of gough-stewart from session, method bundle, ")
    assert repr(result).endswith(": usable>")
    count = len(tool.position)
    assert repr(tool).startswith(f"ToolAccuracy(T_base_platform=<{count} × 4 × 4>, by_parameters=<")


def test_short_reprs_of_all_kinds_of_values():
    tool = ToolAccuracy(np.zeros((2, 4, 4)), np.array(1.0), ["a"] * 30, {"a": np.zeros(3)})
    assert repr(tool) == short_repr(tool)
    assert repr(tool) == (
        "ToolAccuracy(T_base_platform=<2 × 4 × 4>, by_parameters=<one number>, parameters=<list of"
        " 30>, off={'a': array([0., 0., 0.])})"
    )


def test_a_summary_has_verdict_and_figures(result, loaded):
    text = result.summary()
    first, second, *rest = text.splitlines()
    assert first.startswith("Calibration of gough-stewart from session, method bundle")
    assert second == f"✓ {result.verdict.headline}"
    assert [line.split(":")[0].strip() for line in rest[:5]] == [
        "Tool, σ", "Nominal model off", "Parameters", "Stations", "Fit",
    ]  # fmt: skip
    tool = result.tool_error(result.estimate.state.T_base_platform[result.estimate.configurations])
    assert f"{tool.position.mean() * 1e3:#.2g} mm" in rest[0]
    assert loaded.summary() == text
    assert repr(loaded) == repr(result)


def test_what_a_notebook_shows_is_escaped(loaded):
    from dataclasses import replace

    hostile = Finding("", Level.DOUBTFUL, saved_text="a < b & c")
    odd = replace(
        loaded,
        method="<script>",
        verdict=Verdict(False, loaded.verdict.headline, (hostile,)),
    )
    html = odd._repr_html_()
    assert "&lt;script&gt;" in html
    assert "<li>a &lt; b &amp; c</li>" in html
    assert "<script" not in html
    assert "not to be used" in repr(odd)
    assert odd.parameters._repr_html_().count("<tr>") == 1 + len(odd.parameters)


# parameters


def test_parameters_are_a_table(result, loaded):
    value = result.parameters
    table = result.machine.parameters
    assert [row.name for row in value] == list(table.names)
    assert np.array_equal([row.value for row in value], result.machine.values)
    assert np.array_equal([row.drawing for row in value], result.session.machine.values)
    variance = np.diag(result.estimate.covariance)
    assert np.allclose([row.sigma**2 for row in value], variance, atol=1e-30)
    row = value["legs[2].base.center.x"]
    assert row == value[table.index("legs[2].base.center.x")]
    assert row.change == row.value - row.drawing
    assert [r.value for r in loaded.parameters] == [r.value for r in value]
    assert [r.decided_by for r in loaded.parameters] == [r.decided_by for r in value]
    with raises(InputError, expected="a name such as 'legs[2].base.center.x'"):
        value["legs[2].base.centre.x"]


def test_a_table_is_short_as_a_repr_and_whole_when_printed(result):
    lines = repr(result.parameters).splitlines()
    assert lines[0].split() == ["parameter", "nominal", "calibrated", "sigma", "unit", "decided",
                                "by"]  # fmt: skip
    assert lines[-1] == f"… and {len(result.parameters) - 12} more; print() shows all"
    whole = str(result.parameters).splitlines()
    assert len(whole) == 1 + len(result.parameters)
    assert repr(result.parameters[:3]).splitlines() == str(result.parameters[:3]).splitlines()


def test_parameters_as_a_data_frame(result):
    pytest.importorskip("pandas")
    frame = result.parameters.to_pandas()
    assert list(frame.columns) == [
        "unit", "drawing", "value", "change", "sigma", "data_share", "decided_by",
    ]  # fmt: skip
    assert frame.loc["legs[2].base.center.x", "value"] == (
        result.parameters["legs[2].base.center.x"].value
    )
    assert len(frame) == len(result.parameters)


@pytest.mark.parametrize(
    ("missing", "call", "command"),
    [
        ("pandas", lambda r: r.parameters.to_pandas(), "pip install pandas"),
        ("matplotlib", lambda r: r.plot_tool(), "pip install '.[plot]'"),
    ],
)
def test_what_is_not_installed_is_reported(loaded, monkeypatch, missing, call, command):
    monkeypatch.setitem(sys.modules, missing, None)
    with raises(InputError, code="package.missing") as caught:
        call(loaded)
    assert missing in caught.value.what
    assert command in caught.value.next_step


# plots


@pytest.fixture
def axes(monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    yield pyplot.subplots()[1]
    pyplot.close("all")


def test_plots_show_the_numbers(result, loaded, axes):
    assert result.plot_tool(ax=axes) is axes
    nominal, calibrated = (np.asarray(line.get_ydata()) for line in axes.get_lines())
    poses = result.estimate.state.T_base_platform[result.estimate.configurations]
    tool = result.tool_error(poses)
    assert np.allclose(np.sort(calibrated), np.sort(tool.position) * 1e3)
    assert np.allclose(np.sort(nominal), np.sort(tool.off_position) * 1e3)
    for one in (result, loaded):
        ax = one.plot_parameters()
        free = [r for r in one.parameters if r.decided_by in ("data", "drawing")]
        assert [t.get_text() for t in ax.get_yticklabels()] == [r.name for r in free]
        ax = one.plot_residuals()
        area = sum(bar.get_height() * bar.get_width() for bar in ax.patches)
        assert area == pytest.approx(1)
        assert f"{one.overview().residuals.size} residuals" in ax.get_legend_handles_labels()[1]
    few = result.plot_tool(poses[:2]).get_lines()[0].get_ydata()
    assert len(few) == 2


def test_labels_of_the_tools_error_do_not_overlap(result):
    ax = result.plot_tool()
    ax.figure.canvas.draw()
    low, high = ax.get_ylim()
    boxes = [
        label.get_window_extent()
        for at, label in zip(ax.get_yticks(), ax.get_yticklabels(), strict=True)
        if low <= at <= high
    ]
    assert len(boxes) >= 3
    assert all(one.y1 < other.y0 for one, other in pairwise(sorted(boxes, key=lambda b: b.y0)))
    assert not ax.get_yticks(minor=True).size


def test_plots_have_the_colours_of_the_pages():
    style = (Path(__file__).parents[1] / "viewer" / "src" / "style.css").read_text()
    assert f"--calibrated: {plots.CALIBRATED_COLOUR};" in style
    assert f"--drawing: {plots.NOMINAL_COLOUR};" in style
    assert f"--quiet: {plots.QUIET_COLOUR};" in style


def test_residuals_of_a_file_are_those_of_the_result(result, loaded):
    ours, theirs = result.overview().residuals, loaded.overview().residuals
    assert ours.size == theirs.size > 100
    assert np.allclose(np.sort(ours), np.sort(theirs), atol=1e-3)  # rounded in the file


def test_nothing_seen_is_no_plot_of_nothing(axes):
    assert "no edges" in plots.draw_residuals(np.zeros(0), axes).get_title()


# functions


def test_a_result_is_saved_as_the_command_saves_it(result, demo, tmp_path):
    result.save(tmp_path / "out")
    one, two = (
        json.loads((folder / "calibration.json").read_text())
        for folder in (tmp_path / "out", demo.calibration)
    )
    del one["timings"], two["timings"]
    assert one == two
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000


@pytest.mark.parametrize(
    ("option", "value", "found", "expected"),
    [
        ("method", "bundel", "'bundel'", "bundle"),
        ("method", "best", "'best'", "bundle, four-step, linear and inverse-kinematic"),
        ("method", None, "nothing", "bundle, four-step, linear and inverse-kinematic"),
        ("seed", -1, "-1", "a whole number, 0 or more"),
        ("holdout", -2, "-2", "a whole number, 0 to 100000"),
    ],
)
def test_an_option_that_cannot_be_is_refused_before_any_work(option, value, found, expected):
    with raises(InputError, where=option, found=found, expected=expected):
        pkmcal.calibrate("nowhere", **{option: value})


def test_a_session_is_simulated(tmp_path):
    session = pkmcal.simulate(
        tmp_path / "s", "delta", stations=1, configurations=2, seed=3,
        camera=camera_of_size((160, 120)),
    )  # fmt: skip
    assert session.machine.name == "delta"
    assert len(session.configurations) == 2
    assert (tmp_path / "s" / "truth.json").is_file()
    with raises(InputError, found="station", expected="stations"):
        pkmcal.simulate(tmp_path / "t", station=1)
    with raises(InputError, code="output.not_empty", where=str(tmp_path / "s")):
        pkmcal.simulate(tmp_path / "s")
    with raises(InputError, found="nothing") as caught:
        pkmcal.simulate(tmp_path / "t", "nothing")
    assert "gough-stewart" in caught.value.expected
    assert not (tmp_path / "t").exists()


def test_configurations_are_planned(demo, result, planned):
    assert planned.joints.shape == (9, 6)
    assert planned.promised.position < planned.now.position
    of_machine = pkmcal.plan("gough-stewart", count=3, places=1)
    assert of_machine.joints.shape == (3, 6)
    with raises(InputError, code="option.not_applicable", where="--camera"):
        pkmcal.plan(demo.session, camera=result.session.stations[0].camera)
    with raises(InputError, code="option.not_applicable", where="--after"):
        pkmcal.plan("gough-stewart", after=demo.calibration)


# defaults


def test_images_are_of_the_size_that_the_options_say():
    assert default_camera().image_size == (800, 600)
    assert PLANNED_IMAGE_SIZE == (1280, 960)
    assert EdgeNoise().shift == NOMINAL_EDGE_SIGMA


def test_a_notebook_shows_the_report_in_a_frame(result):
    frame = result._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    document = page_document(unescape(frame.partition('srcdoc="')[2].partition('"')[0]))
    assert document["verdict"]["headline"] == result.verdict.headline
