"""Files of a calibration, and that they are read back equal or refused."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from faults import raises
from pkmcal.calibration import results
from pkmcal.calibration.results import base_camera_covariance, calibration_document, check_output
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.files import json_text, json_value
from pkmcal.geometry.rigid import inverse, perturb, pose, pose_difference, rotation
from pkmcal.mechanisms import load_mechanism
from pkmcal.report.calibration import save


@pytest.fixture
def folder(demo, tmp_path):
    """A copy of the demonstration's result."""
    shutil.copytree(demo.calibration, tmp_path / "result")
    return tmp_path / "result"


def everything(folder):
    text = (folder / "calibration.json").read_text()
    return json.loads(text, parse_constant=pytest.fail)


def rewritten(folder, change):
    data = everything(folder)
    change(data)
    (folder / "calibration.json").write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        load(folder)
    return str(caught.value)


# save and load


def test_it_comes_back(calibrated, tmp_path):
    save(calibrated, tmp_path / "out")
    saved, estimate = load(tmp_path / "out"), calibrated.estimate
    assert np.array_equal(saved.machine.values, estimate.machine.values)
    assert np.array_equal(saved.nominal, calibrated.session.machine.values)
    assert np.array_equal(saved.covariance, estimate.covariance)
    assert np.array_equal(saved.sigma, np.sqrt(np.diag(estimate.covariance)))
    assert np.array_equal(saved.data_share, estimate.data_share, equal_nan=True)
    assert np.array_equal(saved.T_base_platform, estimate.state.T_base_platform)
    assert np.array_equal(saved.joints, calibrated.session.joints)
    assert np.array_equal(saved.used, estimate.configurations)
    assert json_value(saved.verdict.document()) == json_value(calibrated.verdict.document())
    assert (saved.gauge, saved.method, saved.seed) == (estimate.gauge, "bundle", 0)
    values = np.stack([station.T_base_camera for station in saved.stations])
    assert np.array_equal(values, inverse(estimate.state.T_camera_base))
    assert load(tmp_path / "out" / "calibration.json").path == saved.path


def test_the_file_holds_everything(folder, calibrated):
    data = everything(folder)
    names = [row["name"] for row in data["parameters"]]
    assert names == list(calibrated.machine.parameters.names)
    assert {row["decided_by"] for row in data["parameters"]} <= {
        "data",
        "drawing",
        "frame",
        "fixed",
    }
    assert {row["unit"] for row in data["parameters"]} == {"m", ""}
    assert len(data["residuals"]["edges"]) == len(calibrated.observation.edges)
    assert len(data["residuals"]["edges"][0]) == len(data["residuals"]["columns"])
    assert sum(group["count"] for group in data["rejected"]) == len(calibrated.observation.rejected)
    assert data["cameras"][0]["file"] == "cameras/camera.yaml"
    assert {"pkmcal", "python", "numpy", "opencv-contrib-python-headless"} <= set(data["versions"])
    assert set(data["timings"]) == {"load", "decode", "observe", "identify"}
    assert data["session"]["joints"]["columns"] == [f"leg{n}" for n in range(1, 7)]
    assert "as far as residuals show them" in data["conventions"]


def test_numbers_that_are_none_become_null(calibrated):
    document = calibration_document(calibrated)
    document["statistics"]["chi2"] = float("nan")
    document["covariance"] = np.array([np.inf, 1.0])
    data = json.loads(json_text(document), parse_constant=pytest.fail)
    assert data["statistics"]["chi2"] is None
    assert data["covariance"] == [None, 1.0]


def test_the_mechanism_file_states_what_it_is(folder, calibrated):
    path = folder / "mechanism.yaml"
    comment = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert re.match(
        r"# Calibrated by pkmcal \S+ from the session session \(method bundle", comment[0]
    )
    assert comment[1] == f"# {calibrated.verdict.headline}"
    assert np.array_equal(load_mechanism(path).values, calibrated.machine.values)


def test_twice_the_same_but_for_the_timings(folder, calibrated, tmp_path):
    save(calibrated, tmp_path / "again")
    one, two = everything(folder), everything(tmp_path / "again")
    assert one.pop("timings") != two.pop("timings")
    assert one == two
    texts = [(place / "mechanism.yaml").read_text() for place in (folder, tmp_path / "again")]
    assert texts[0] == texts[1]


# an earlier result


def files_in(place):
    return {path.name: path.read_bytes() for path in place.iterdir()}


def dated(out):
    """Folders of earlier results beside a result's."""
    return sorted(path for path in out.parent.iterdir() if path.name.startswith(f"{out.name}-"))


@pytest.fixture
def earlier(folder, tmp_path) -> Path:
    """A result of some other seed, of a quarter past three on a winter's day."""
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    path = out / "calibration.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 7'))
    then = datetime(2026, 11, 23, 15, 2, 7).timestamp()
    os.utime(path, (then, then))
    return out


def test_an_earlier_result_is_kept_under_its_date(calibrated, earlier):
    before = files_in(earlier)
    retained = save(calibrated, earlier)
    assert retained == earlier.with_name("out-2026-11-23T1502")
    assert dated(earlier) == [retained]
    assert files_in(retained) == before
    assert load(retained).seed == 7  # as good a calibration as any
    assert load(earlier).seed == 0


def test_the_same_result_is_not_kept_twice(calibrated, folder, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    path = out / "calibration.json"
    path.write_text(re.sub(r'"decode": [0-9.]+', '"decode": 12345.0', path.read_text()))
    (out / "report.html").unlink()
    assert save(calibrated, out) is None
    assert dated(out) == []
    assert (out / "report.html").exists()


def test_a_result_that_was_changed_by_hand_is_kept(calibrated, folder, tmp_path):
    for name in ("mechanism.yaml", "calibration.json"):
        out = tmp_path / name
        shutil.copytree(folder, out)
        (out / name).write_text((out / name).read_text() + "\n#")
        assert files_in(save(calibrated, out))[name].endswith(b"\n#")


def test_force_replaces_it(calibrated, earlier):
    assert save(calibrated, earlier, force=True) is None
    assert dated(earlier) == []
    assert load(earlier).seed == 0


def test_two_of_one_minute_are_both_kept(calibrated, earlier, folder):
    other = (folder / "calibration.json").read_text().replace('"seed": 0', '"seed": 8')
    then = (earlier / "calibration.json").stat().st_mtime + 20
    save(calibrated, earlier)
    (earlier / "calibration.json").write_text(other)
    os.utime(earlier / "calibration.json", (then, then))
    save(calibrated, earlier)
    names = [place.name for place in dated(earlier)]
    assert names == ["out-2026-11-23T1502", "out-2026-11-23T1502-2"]
    assert [load(place).seed for place in dated(earlier)] == [7, 8]


def test_a_run_that_was_killed_after_the_copy_leaves_no_second_one(
    calibrated, earlier, monkeypatch
):
    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("pkmcal.report.calibration.write_folder", killed)
        with pytest.raises(KeyboardInterrupt):
            save(calibrated, earlier)
    assert load(earlier).seed == 7
    save(calibrated, earlier)
    assert len(dated(earlier)) == 1
    assert load(earlier).seed == 0


def test_where_nothing_can_be_kept_it_is_reported_before_the_work(earlier, monkeypatch):
    def refuse(place):
        if place == earlier.parent:
            raise InputError("cannot be written")

    monkeypatch.setattr(results, "check_writable", refuse)
    with raises(InputError, code="output.earlier_not_kept", where=str(earlier)) as caught:
        check_output(earlier)
    assert "--force" in caught.value.next_step
    assert "report.html" in check_output(earlier, force=True)


# whole or not at all


def test_a_failed_save_leaves_the_old_result(folder, calibrated, monkeypatch):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def fail(*_calibration):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pkmcal.report.calibration.calibration_document", fail)
    with raises(OSError, errno=errno.ENOSPC):
        save(calibrated, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("name", ["notes.txt", "mechanism.yaml", ".git"])
def test_foreign_files_are_not_overwritten(tmp_path, name):
    (tmp_path / name).touch()
    with raises(InputError, code="output.foreign_files", found=name):
        check_output(tmp_path)


def test_new_and_empty_folders_and_results_are_fine(tmp_path, folder):
    check_output(tmp_path / "new" / "deep")
    assert not (tmp_path / "new").exists()
    (tmp_path / "empty").mkdir()
    check_output(tmp_path / "empty")
    check_output(folder)


# a file that was changed


def test_nothing_there(tmp_path):
    with pytest.raises(InputError) as refused:
        load(tmp_path)
    assert refused.value.where == str(tmp_path)
    assert refused.value.next_step is None


def test_a_session_names_its_calibration(tmp_path):
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "calibration.json").write_text("{}")
    with pytest.raises(InputError) as refused:
        load(tmp_path)
    assert str(tmp_path / "calibration") in refused.value.next_step


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not valid JSON"),
        ('{"NaN":\n1,\n"a": NaN}', "json, line 3: not a number in JSON; found 'NaN'"),
        ('{"a\\"": [\n-Infinity, 1]}', "json, line 2: not a number in JSON; found '-Infinity'"),
        ('{"a": ' + "1" * 5000 + "}", "json, line 1: not a number in JSON; found '1111"),
        ("[]", "the top of the file is not an object"),
        ('{"a": 1}', "this is not a calibration; expected 1"),
        (
            '{"pkmcal_calibration": 9}',
            "version of calibration files is not supported; found 9, expected 1",
        ),
        ('{"pkmcal_calibration": 1}', "verdict"),
        ("[" * 20_000, "not"),
    ],
)
def test_other_files(tmp_path, text, message):
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(InputError) as caught:
        load(tmp_path)
    assert message in str(caught.value)


def test_a_changed_value(folder):
    text = rewritten(folder, lambda data: data["parameters"][4].update(value=0.1))
    assert "parameters[5].value: the calibration file is inconsistent" in text
    assert "Calibrate again" in text


def test_a_lost_reading(folder):
    text = rewritten(folder, lambda data: data["configurations"][2]["joints"].pop())
    assert "configurations[3].joints: the calibration file is inconsistent" in text
    assert "expected the 6 readings of its machine, not 5" in text


def test_a_changed_name(folder):
    text = rewritten(folder, lambda data: data["parameters"].pop())
    assert "expected the names of the mechanism's parameters" in text


def test_a_changed_covariance(folder):
    text = rewritten(folder, lambda data: data["covariance"].pop())
    assert "the covariance has another size than the list of parameters" in text


def test_a_covariance_that_is_none(folder):
    def turn(data):
        data["covariance"][7][8] += 1e-6

    assert "not symmetric and positive semidefinite" in rewritten(folder, turn)


def test_covariances_of_stations_come_back_with_the_machine(calibrated, tmp_path):
    """In the estimator's own numbers, whole and by name."""
    save(calibrated, tmp_path / "out")
    saved, estimate = load(tmp_path / "out"), calibrated.estimate
    assert saved.placed == calibrated.session.station_names
    joint = estimate.joint_covariance
    size = np.sqrt(np.outer(np.diag(joint), np.diag(joint)))
    assert np.all(np.abs(saved.joint_covariance - joint) <= 1e-9 * size)
    n, last = len(saved.covariance), len(saved.placed) - 1
    prior = saved.prior(saved.placed[-1:], saved.placed)
    one = prior.covariance
    assert prior.stations == (last,)
    there = inverse(prior.T_camera_base)[0]
    np.testing.assert_allclose(there, saved.stations[last].T_base_camera, atol=1e-15)
    rows = np.r_[:n, n + 6 * last : n + 6 * last + 6]
    assert np.array_equal(one, saved.joint_covariance[np.ix_(rows, rows)])
    # the station is not independent of the machine that was found with it
    unit = np.abs(one[n:, :n]) / np.sqrt(np.outer(np.diag(one)[n:], np.diag(one)[:n]) + 1e-300)
    assert unit.max() > 0.3
    values = np.sqrt(
        np.diag(base_camera_covariance(estimate.state.T_camera_base[last], one[n:, n:]))
    )
    assert np.allclose(values[3:], saved.stations[last].sigma_translation, rtol=1e-9)
    with raises(InputError, code="calibration.no_covariance", found="attic"):
        saved.prior(["attic"], ["attic"])


def test_a_file_without_the_stations_covariance_still_loads(folder):
    data = everything(folder)
    del data["station_covariance"]
    (folder / "calibration.json").write_text(json.dumps(data))
    saved = load(folder)
    assert saved.placed == ()
    assert np.array_equal(saved.joint_covariance, saved.covariance)
    (name, *_) = (station.name for station in saved.stations)
    with raises(InputError, code="calibration.no_covariance", found=name):
        saved.prior([name], [name])


def test_a_covariance_of_stations_that_is_none(folder):
    def shortened(data):
        data["station_covariance"]["rows"].pop()

    assert "another size than the lists of parameters and st" in rewritten(folder, shortened)


@pytest.mark.parametrize("what", ["renamed", "stretched"])
def test_stations_that_do_not_fit(folder, what):
    def change(data):
        if what == "renamed":
            data["station_covariance"]["stations"][0] = "attic"
            return
        n = len(data["parameters"])
        for row in data["station_covariance"]["rows"]:  # symmetric, with correlations above one
            row[:n] = [3 * value for value in row[:n]]

    text = rewritten(folder, change)
    wanted = {"renamed": "expected names of the stations", "stretched": "positive semidefinite"}
    assert wanted[what] in text


def test_a_pose_that_is_none(folder):
    def mirror(data):
        data["stations"][1]["T_base_camera"][0] = [-1.0, 0.0, 0.0, 0.0]

    assert "stations[2].T_base_camera" in rewritten(folder, mirror)


def test_a_missing_field(folder):
    assert "gauge" in rewritten(folder, lambda data: data.pop("gauge"))


def test_a_verdict_of_before_findings_had_codes_still_loads(folder):
    data = everything(folder)
    del data["verdict"]["findings"]
    data["verdict"] |= {"reasons": ["No."], "warnings": ["Look."], "advice": ["Do."]}
    (folder / "calibration.json").write_text(json.dumps(data))
    verdict = load(folder).verdict
    assert (verdict.reasons, verdict.warnings, verdict.advice) == (("No.",), ("Look.",), ("Do.",))
    assert set(verdict.codes) == {""}


def test_fields_of_a_newer_version_do_not_matter(folder):
    data = everything(folder)
    data["novelty"] = 1
    data["stations"][0]["novelty"] = 1
    (folder / "calibration.json").write_text(json.dumps(data))
    assert load(folder).document["novelty"] == 1


# the cameras' covariance


def test_covariance_of_the_inverse_pose():
    rng = np.random.default_rng(3)
    T = pose(rotation(np.array([0.4, -0.9, 1.3])), np.array([0.2, -0.5, 1.1]))
    # numeric derivative of the inverse's six numbers by those of the pose
    step = 1e-6
    columns = [pose_difference(inverse(perturb(T, step * e)), inverse(T)) / step for e in np.eye(6)]
    jacobian = np.stack(columns, axis=-1)
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    values = base_camera_covariance(T, covariance)
    assert np.allclose(values, jacobian @ covariance @ jacobian.T, rtol=1e-4, atol=1e-4)
