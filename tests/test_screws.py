"""Screws that universal joints turn: the reading's excess, exports, and a wrong lead."""

from __future__ import annotations

import numpy as np
import pytest

import pkmcal
from export_sources import source_of
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.errors import InputError
from pkmcal.exporters.contract import exporters, make_export
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import perturb, rotation
from pkmcal.mechanisms import catalogue, load_mechanism, mechanism_text
from pkmcal.mechanisms.closure import closure, dense
from screw_hexapod import LEAD, screw_hexapod
from test_kinematics import differences
from test_pose_sessions import make


@pytest.fixture(scope="module")
def machine():
    """Parameters off their nominal values, axes of another length than 1 too."""
    nominal = screw_hexapod()
    rng = np.random.default_rng(1)
    return nominal.with_values(nominal.values + 0.01 * rng.normal(size=len(nominal.values)))


def test_a_reading_has_the_turn_of_the_joints(machine):
    """By rotations: the base's axis turned about the leg by phi is the platform's, seen along
    the leg.
    """
    document, table = machine.to_document(), machine.parameters.unit_axes(machine.values)
    excess = []
    for T, readings in zip(*samples(machine, 20), strict=True):
        for leg, reading in zip(document["legs"], readings, strict=True):
            a, b = (np.array(leg[end]["center"]) for end in ("base", "platform"))
            d = T[:3, :3] @ b + T[:3, 3] - a
            distance = np.linalg.norm(d)
            grown = leg["scale"] * reading + leg["length"]["offset"] - distance
            turn = rotation(2 * np.pi * grown / LEAD * d / distance)
            first = turn @ leg["base"]["axis"]
            second = T[:3, :3] @ leg["platform"]["axis"]
            across = np.cross(np.cross(d, first), np.cross(d, second))
            np.testing.assert_allclose(across, 0, atol=1e-12)
            excess.append(grown)
    assert table.size == len(machine.values)
    assert 1e-4 < np.max(np.abs(excess)) < LEAD / 4


def test_a_right_hand_thread_grows_with_a_right_hand_turn():
    """A yaw of the platform turns all legs of a hexapod to the same side."""
    machine = screw_hexapod()
    T = machine.home()
    T[:3, :3] = rotation(np.array([0, 0, 0.1])) @ T[:3, :3]
    grown = machine.inverse(T) - screw_hexapod(0.0).inverse(T)
    assert (grown > 0.5 * LEAD * 0.1 / (2 * np.pi)).all()
    np.testing.assert_allclose(screw_hexapod(-LEAD).inverse(T) + grown, machine.inverse(T) - grown)


@pytest.mark.parametrize("k", range(3))
def test_derivatives(machine, k):
    layout, theta = machine.layout, machine.values
    T, q = (values[k] for values in samples(machine, 3))
    c = closure(layout, theta, q, T)
    by_pose = differences(lambda d: closure(layout, theta, q, perturb(T, d)).rows.value, 6, 1e-3)
    np.testing.assert_allclose(c.rows.by_pose, by_pose, atol=1e-11)
    count = len(theta)
    by_theta = differences(lambda d: closure(layout, theta + d, q, T).rows.value, count, 1e-3)
    np.testing.assert_allclose(dense(c, count), by_theta, atol=1e-11)
    by_reading = differences(lambda d: machine.inverse(perturb(T, d)), 6, 1e-3)
    np.testing.assert_allclose(machine.inverse_jacobian(T), by_reading, atol=1e-11)


def test_poses_come_back(machine):
    poses, readings = samples(machine, 30)
    near = perturb(poses, 0.02 * np.random.default_rng(2).normal(size=(len(poses), 6)))
    result = machine.forward_result(readings, near)
    assert result.converged.all()
    np.testing.assert_allclose(result.T_base_platform, poses, atol=1e-11)


def test_axes_have_no_sense(machine):
    poses = samples(machine, 10)[0]
    same, turned = screw_hexapod(), screw_hexapod(turned=-1.0)
    np.testing.assert_allclose(same.inverse(poses), turned.inverse(poses), atol=1e-15)


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_genhexkins_has_lead_and_axes(turned, tmp_path):
    machine = screw_hexapod(turned=turned)
    made = make_export(source_of(machine), "linuxcnc")
    hal = made.files["pkmcal_kinematics.hal"]
    assert f"setp genhexkins.screw-lead {1e3 * LEAD:g}\n" in hal
    # another lead in the text is another machine
    wrong = made.files | {"pkmcal_kinematics.hal": hal.replace("screw-lead 5", "screw-lead -5")}
    assert exporters()["linuxcnc"].check(wrong, source_of(machine))[0].beyond
    # and the file is read again
    path = tmp_path / "machine.hal"
    path.write_text(hal)
    pkmcal.new(from_file=path, unit="mm", leg=0.415).save(tmp_path / "mine")
    again = load_mechanism(tmp_path / "mine" / "mechanism.yaml")
    poses = samples(machine, 10)[0]
    np.testing.assert_allclose(again.inverse(poses), machine.inverse(poses), atol=2e-6)


def test_struts_of_two_leads_need_the_module():
    machine = screw_hexapod()
    legs = list(machine.document.legs)
    legs[2] = legs[2].model_copy(
        update={"length": legs[2].length.model_copy(update={"lead": -LEAD})}
    )
    other = machine.document.model_copy(update={"legs": tuple(legs)})
    made = make_export(source_of(pkmcal.mechanisms.machine_from_document(other)), "linuxcnc")
    assert "pkmcal_kins.c" in made.files


@pytest.mark.parametrize("axes", ["incomplete", "without direction"])
def test_a_lead_needs_axes(axes, tmp_path):
    hal = make_export(source_of(screw_hexapod()), "linuxcnc").files["pkmcal_kinematics.hal"]
    lines = hal.splitlines()
    of_one = [line for line in lines if ".platform-n.3." in line]
    for line in of_one:
        lines.remove(line)
        if axes == "without direction":
            lines.append(f"{line.rpartition(' ')[0]} 0")
    (tmp_path / "h.hal").write_text("\n".join(lines))
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "h.hal", unit="mm", leg=0.415)
    assert refused.value.where == "h.hal"


@pytest.mark.parametrize("to", ["mujoco", "sdf", "urdf"])
def test_what_a_format_cannot_hold_is_noted(to):
    machine = screw_hexapod()
    made = make_export(source_of(machine), to)
    (note,) = (one for one in made.notes if one.code == "export.without_screws")
    poses, readings = samples(machine)
    expected = np.abs(screw_hexapod(0.0).inverse(poses) - readings).max()
    assert note.facts["largest"] == pytest.approx(expected)


def test_a_lead_without_two_axes_is_refused(tmp_path):
    text = catalogue()["gough-stewart"].read_text()
    path = tmp_path / "m.yaml"
    path.write_text(text.replace("0.485]", "0.485], lead: 5 mm", 1))
    with pytest.raises(InputError) as refused:
        load_mechanism(path)
    assert str(refused.value.where).endswith("legs[1].length.lead")


@pytest.mark.parametrize("lead", [LEAD, pytest.param(-LEAD, marks=pytest.mark.slow)])
def test_a_thread_of_the_other_hand_is_named(lead, tmp_path):
    (tmp_path / "true.yaml").write_text(mechanism_text(screw_hexapod()))
    made = make(tmp_path / "session", tmp_path / "true.yaml", n=40)
    (tmp_path / "session" / "mechanism.yaml").write_text(mechanism_text(screw_hexapod(lead)))
    result = calibrate_session(made.folder)
    named = [one for one in result.violations if one.code == "machine.screw_lead"]
    assert len(named) == (lead < 0)
    for one in named:
        sigma = one.finding.facts["sigma"]
        assert one.finding.facts["fits"] == pytest.approx(LEAD, abs=4 * sigma)
        assert sigma < LEAD / 5
