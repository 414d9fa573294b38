"""Difference of two machines: its distribution by chance, its frames, the tool, the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import run
from document_keys import assert_keys
from faults import raises
from page_documents import page_blocks, page_document
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.gauge import moved_centres
from pkmcal.judge.difference import _shared_data, difference
from pkmcal.judge.machine_change import machine_change
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level
from pkmcal.report.difference import outcome_of
from test_bundle import estimate
from test_identify_scene import make_scene

# ------------------------------------------------------------------ what chance does

PAIRS = 5


def of_configurations(measurements, keep):
    chosen = np.isin(measurements.edges.configuration, keep)
    return replace(measurements, edges=measurements.edges.select(chosen))


@pytest.fixture(scope="module")
def pairs():
    """Pairs of estimates of machines that did not change, by what of their data is common."""
    out = {"new data": [], "half of the data": [], "all data of the smaller": []}
    for seed in range(PAIRS):
        rng = np.random.default_rng(seed)
        scene = make_scene(rng)
        one, other = scene.measurements(rng), scene.measurements(rng)
        k = len(one.joints)
        a = estimate(scene, one, rng)
        out["new data"].append((a, estimate(scene, other, rng), 0.0))
        first, last = (
            estimate(scene, of_configurations(one, keep), rng)
            for keep in (np.arange(2 * k // 3), np.arange(k // 3, k))
        )
        out["half of the data"].append((first, last, 0.5))
        few = estimate(scene, of_configurations(one, np.arange(k // 2)), rng)
        out["all data of the smaller"].append((few, a, 1.0))
    return out


def changes(pairs):
    return [
        machine_change(a.machine, b.machine, (a.covariance, b.covariance), shared=shared)
        for a, b, shared in pairs
    ]


@pytest.mark.parametrize("kind", ["new data", "half of the data", "all data of the smaller"])
def test_the_stated_spread_is_that_of_unchanged_machines(pairs, kind):
    """Over 5 pairs with 47 degrees of freedom the mean of chi-square has a deviation of 0.09."""
    value = changes(pairs[kind])
    dof = sum(c.dof for c in value)
    assert sum(c.chi2 for c in value) / dof == pytest.approx(1, abs=0.2)
    z = np.concatenate([(c.change / np.maximum(c.sigma, 1e-12))[c.sigma > 1e-9] for c in value])
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.03)


def test_common_data_make_a_smaller_spread_and_that_is_needed(pairs):
    """As if independent, estimates that share data would agree too well."""
    kind = pairs["half of the data"]
    alone = [machine_change(a.machine, b.machine, (a.covariance, b.covariance)) for a, b, _ in kind]
    ratio = sum(c.chi2 for c in alone) / sum(c.dof for c in alone)
    assert ratio < 0.75
    assert np.all(alone[0].sigma >= changes(kind)[0].sigma - 1e-12)


def test_a_result_beside_itself(pairs):
    a = pairs["new data"][0][0]
    values = machine_change(a.machine, a.machine, (a.covariance, a.covariance), shared=1.0)
    assert np.abs(values.change).max() < 1e-12
    assert values.chi2 < 1e-6


def test_frames_make_no_difference(pairs):
    a, b, _ = pairs["new data"][1]
    rng = np.random.default_rng(0)
    e, f = (perturb(np.eye(4), rng.normal(size=6) * 0.05) for _ in range(2))
    theta = moved_centres(b.machine.layout, b.machine.values, e, f)
    shifted = b.machine.with_values(theta)
    same = machine_change(a.machine, a.machine.with_values(
        moved_centres(a.machine.layout, a.machine.values, e, f)), (None, None))  # fmt: skip
    assert np.abs(same.change).max() < 1e-9
    one = machine_change(a.machine, b.machine, (None, None)).change
    two = machine_change(a.machine, shifted, (None, None)).change
    assert np.allclose(one, two, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "times"), [("legs[3].length.offset", 7.0), ("legs[5].platform.center.z", 14.0)]
)
def test_what_changed_is_found_where_it_changed(pairs, name, times):
    """A change of seven standard deviations, of which chance may take two; a frame absorbs half of
    the height of one of six joints, as a plane fitted to six points does.
    """
    hits = 0
    for a, b, _ in pairs["new data"]:
        k = a.machine.parameters.index(name)
        quiet = machine_change(a.machine, b.machine, (a.covariance, b.covariance))
        values = b.machine.values.copy()
        values[k] += times * quiet.sigma[k]
        value = machine_change(a.machine, b.machine.with_values(values), (a.covariance,
                               b.covariance))  # fmt: skip
        z = np.abs(value.change) / np.maximum(value.sigma, 1e-9)
        hits += z[k] > 3.5
        assert value.chi2 > quiet.chi2
    assert hits >= PAIRS - 1


def test_a_nominal_model_is_taken_at_its_word(pairs):
    a = pairs["new data"][0][0]
    nominal = a.machine.with_values(a.machine.parameters.nominal)
    value = machine_change(nominal, a.machine, (None, a.covariance))
    assert value.dof > 40
    assert value.chi2 > 10 * value.dof  # it was built two millimetres off
    both = machine_change(nominal, a.machine, (None, None))
    assert both.dof == 0
    assert not both.sigma.any()
    assert np.allclose(both.change, value.change)


# ------------------------------------------------------------------ calibrations


@pytest.fixture
def saved(demo):
    return load(demo.calibration)


def changed(saved, name, by):
    values = saved.machine.values.copy()
    values[saved.machine.parameters.index(name)] += by
    return replace(saved, machine=saved.machine.with_values(values))


def test_after_a_crash(saved):
    """The same standard deviations, another offset of leg 3, and images of its own."""
    k = saved.machine.parameters.index("legs[3].length.offset")
    after = changed(saved, "legs[3].length.offset", 8e-3)
    document = json.loads(json.dumps(saved.document))
    for entry in document["configurations"]:
        entry["photographs"] = [f"new {digest}" for digest in entry["photographs"]]
    value = difference(saved, replace(after, document=document))
    assert value.changed
    assert value.shared == 0
    assert value.ordered[0] == k
    assert value.change.change[k] == pytest.approx(8e-3, rel=0.35)
    assert value.verdict.headline.startswith("The calibrations differ by more than chance")
    assert value.verdict.reasons[0].startswith("Leg 3 ")
    assert outcome_of(value).exit_code == 1
    # what leg 3's zero does to the tool, at the same readings
    table = value.tool.after
    even = slice(0, value.tool.spread)
    poses = table.T_base_platform[even]
    readings = after.machine.inverse(poses)
    away = saved.machine.forward_result(readings, poses).T_base_platform
    shifted = np.linalg.norm(away[:, :3, 3] - poses[:, :3, 3], axis=1)
    ratio = np.nanmedian(table.off_position[even]) / np.nanmedian(shifted)
    assert 0.2 < ratio < 1.2  # less, for frames take a part of it


def test_shared_images_are_counted(saved):
    value = difference(saved, saved)
    assert not value.changed
    assert value.shared == int(saved.used.sum())
    assert value.verdict.headline == (
        "The two are the same: no number differs by more than rounding."
    )
    assert any("100 % of what" in text for text in value.assumed)


def test_images_are_counted_however_they_are_grouped(saved):
    """Three images under one name or under three have as much in common."""
    each = [{"photographs": {f"{k}.png"}} for k in range(6)]
    grouped = [{"photographs": {f"{k}.png" for k in row}} for row in ((0, 1, 2), (6, 7, 8))]

    def of(configurations):
        used = np.ones(len(configurations), dtype=bool)
        return replace(saved, document={"configurations": configurations}, used=used)

    assert _shared_data([of(each), of(grouped)]) == (3, 3 / 6)
    assert _shared_data([of(grouped), of(each)]) == (1, 3 / 6)
    assert _shared_data([of(each), of(each)]) == (6, 1.0)


def test_a_refused_calibration_is_no_base_for_a_comparison(saved):
    refused = replace(
        saved, verdict=Verdict(False, "Bad.", (Finding("", Level.WRONG, saved_text="No light."),))
    )
    value = difference(saved, refused)
    assert not value.changed
    assert not value.verdict.usable
    assert "was refused when it was made: No light." in value.verdict.reasons[0]
    assert outcome_of(value).exit_code == 1


def test_another_machine_is_refused(saved):
    with raises(InputError, code="difference.machines", where="delta"):
        difference(saved, "delta")


def test_two_nominal_models():
    nominal = load_mechanism("gough-stewart")
    values = nominal.values.copy()
    k = nominal.parameters.index("legs[2].length.offset")
    values[k] += 1e-3
    value = difference(nominal, nominal.with_values(values))
    assert value.changed
    assert value.change.dof == 0
    assert value.ordered[0] == k
    assert value.verdict.headline.startswith("The nominal models differ: the tool differs by ")
    assert outcome_of(value).exit_code == 0
    assert np.isnan(value.chances).all()
    document = value.as_dict()
    assert document["chi2"] is None
    assert document["parameters"][k]["change"] == pytest.approx(1e-3, rel=0.2)


def test_a_fixed_number_that_differs_is_reported():
    """It has no standard deviation, and no frame can absorb it."""
    nominal = load_mechanism("gough-stewart")
    name = "legs[2].length.offset"
    held = replace(nominal, parameters=nominal.parameters.with_roles(fixed=(name,)))
    k = nominal.parameters.index(name)
    values = held.values.copy()
    values[k] += 1e-4
    value = difference(held, held.with_values(values))
    assert value.change.change[k] == pytest.approx(1e-4)
    assert value.changed


# ------------------------------------------------------------------ command


def test_the_command(demo, tmp_path):
    out = tmp_path / "d"
    done = run("diff", demo.calibration, demo.calibration, "-o", out)
    assert done.code == 0
    assert "✓ The two are the same" in done.out
    assert {path.name for path in out.iterdir()} == {"diff.html", "diff.json"}
    done = run("diff", demo.calibration, "gough-stewart", "-o", out, "--json")
    values = done.json
    assert_keys("diff --json", values)
    # a change from a nominal model is what was asked for
    assert (done.code, values["exit_code"]) == (0, 0)
    assert values["verdict"]["reasons"] == []
    assert (values["a"]["kind"], values["b"]["kind"]) == ("calibration", "drawing")
    assert values["changed"] is True
    assert values["chance"] < 1e-6
    assert values["tool"]["change"]["position"]["median"] > 1e-3
    assert values["shared_configurations"] == 0
    page = page_document((out / "diff.html").read_text())
    assert page["verdict"]["tone"] == "neutral"
    (stage,) = page_blocks(page, "space")
    (arrows,) = stage["arrows"]
    sizes = np.linalg.norm(arrows["vectors"], axis=1)
    assert np.median(sizes) == pytest.approx(values["tool"]["change"]["position"]["median"], 1e-3)
    # the arrows, metres before, are shorter than a tenth of the machine
    assert 1 < stage["enlargement"] < 0.05 / np.quantile(sizes, 0.9)
    (bars,) = page_blocks(page, "plot")
    assert [mark["name"] for mark in bars["marks"]] == ["base joint", "platform joint"]
    done = run("diff", demo.calibration, "gough-stewart", "-o", out)
    assert (
        "· Nominal model and calibration differ by more than chance explains: the tool" in done.out
    )
    assert "What changed" in done.out
    assert max(map(len, done.out.splitlines())) <= 80 + len(str(out))


@pytest.mark.parametrize(
    ("other", "code"),
    [
        ("h5", "machine.unknown"),
        ("delta", "difference.machines"),
        (".", "calibration.missing"),
    ],
)
def test_what_cannot_be_compared(other, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("diff", "gough-stewart", other, "--json")
    assert (done.code, done.json["code"]) == (2, code)
    assert not (tmp_path / "diff").exists()


def test_an_earlier_difference_is_kept_beside_the_calibration(demo, tmp_path, monkeypatch):
    """An existing file is not overwritten, and nothing is written into the current folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(demo.calibration, tmp_path / "machine" / "calibration")
    b = "../machine/calibration"
    first = run("diff", "gough-stewart", b, "--json").json
    folder = tmp_path / "machine" / "diff"
    assert first["files"]["diff.json"] == str(folder / "diff.json")
    before = (folder / "diff.json").read_text()
    assert "kept" not in run("diff", "gough-stewart", b, "--json").json
    second = run("diff", b, b, "--json").json
    retained = Path(second["kept"])
    assert retained.parent == folder.parent
    assert retained.name.startswith("diff-20")
    assert (retained / "diff.json").read_text() == before != (folder / "diff.json").read_text()
    assert (retained / "diff.html").is_file()
    assert "kept" not in run("diff", "gough-stewart", b, "--force", "--json").json
    assert sorted(p.name for p in folder.parent.iterdir()) == ["calibration", "diff", retained.name]
    assert list((tmp_path / "here").iterdir()) == []


def test_a_folder_with_other_things_is_left_alone(demo, tmp_path):
    shutil.copytree(demo.calibration, tmp_path / "a")
    done = run("diff", tmp_path / "a", tmp_path / "a", "-o", tmp_path / "a", "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")


def test_a_machine_without_a_map_is_compared_all_the_same(tmp_path):
    """Its motors cannot go to the home pose."""
    path = tmp_path / "h4.yaml"
    text = catalogue()["h4"].read_text()
    path.write_text(text.replace("range: [-0.1, 1.15]", "range: [-0.1, 0.1]"))
    value = difference(str(path), str(path))
    outcome = outcome_of(value)
    assert "There is no map of the workspace: " in outcome.parts[0].text[0]
    assert value.as_dict()["tool"]["why_not"]
    (stage,) = outcome.parts[0].blocks
    assert stage.arrows == ()
    sides = [side for leg in stage.changes[0] for side in (leg.base[-1], leg.platform[-1])]
    np.testing.assert_allclose(sides, 0, atol=1e-9)
