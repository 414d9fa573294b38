"""A carrier outside the package, as in docs/machines.md: it loads, moves, calibrates, is rendered,
described and exported like any other.
"""

from __future__ import annotations

import gc
import importlib
import os
import subprocess
import sys

import numpy as np
import pytest

import test_carriers
import test_catalogue
from export_sources import source_of
from faults import raises
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.files import yaml_text
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information, identifiability
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.unidentified import explain
from pkmcal.judge.causes import single_causes
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.mechanisms.carriers.contract import Winding, base_carriers
from pkmcal.mechanisms.carriers.crank import Crank
from pkmcal.mechanisms.closure import closure, dense, limb_ends
from pkmcal.mechanisms.drives import BENT_GUIDE_PIECES, drives_of
from pkmcal.simulation import with_forearms
from pkmcal.simulation.scene import Finish, discs_of, machine_parts
from pkmcal.simulation.shapes import Box
from pkmcal.simulation.surfaces import SmoothNoise
from pkmcal.web.stage import machine_shape

CARRIERS = '''\
"""Carriers of one's own: a crank whose arm leaves its axis aslant, and a guide that is an arc."""

from typing import Literal

import numpy as np

from pkmcal.files import Schema
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier, Chain, Direction, Stroke, NamedMotion, ParameterKind, vectors,
)


class LeaningDocument(Schema):
    joint: Literal["leaning-crank"]
    center: tuple[float, float, float]
    axis: Direction
    arm: tuple[float, float, float]
    range: Stroke | None = None


class LeaningCrank(BaseCarrier):
    """``A = center + arm``, the arm turned by the reading about the unit axis v."""

    joints = ("leaning-crank",)
    schema = LeaningDocument
    driven, unit = True, "rad"
    ways = ("arm",)
    parameters = (
        *vectors("center", "m", "center"),
        *vectors("axis", "1", "axis"),
        *vectors("arm", "m", "arm", part="arm"),
    )

    @staticmethod
    def place(parameters, readings):
        center, v, arm = unit_axis(parameters)
        c, s = np.cos(readings)[..., None], np.sin(readings)[..., None]
        turned = c * arm + s * cross(v, arm) + (1 - c) * dot(v, arm)[..., None] * v
        return center + turned, cross(v, turned)

    @staticmethod
    def chain(parameters):
        return Chain("turn", *unit_axis(parameters))

    @staticmethod
    def motions(parameters, readings):
        v = unit_axis(parameters)[1]
        slide = np.concatenate([v, 0 * v, -v])[:, None]
        where = "where on its axis {each}{legs} has its centre {is}"
        return (NamedMotion(slide, one=where, several=where),)


def unit_axis(parameters):
    center, axis, arm = (parameters[..., k : k + 3] for k in (0, 3, 6))
    return center, axis / np.sqrt(dot(axis, axis))[..., None], arm


class ArcDocument(Schema):
    joint: Literal["arc"]
    center: tuple[float, float, float]
    axis: Direction
    normal: Direction
    radius: float
    range: Stroke | None = None


class Arc(BaseCarrier):
    """A carriage that begins at ``center`` along ``axis`` and turns towards ``normal``; m."""

    joints = ("arc",)
    schema = ArcDocument
    driven = True
    parameters = (
        *vectors("center", "m", "center"), *vectors("axis", "1", "axis"),
        *vectors("normal", "1", "axis"), ParameterKind("radius", "m", "arm"),
    )

    @staticmethod
    def place(parameters, readings):
        center, t, raw = unit_axis(parameters)
        n = raw - dot(raw, t)[..., None] * t
        n = n / np.sqrt(dot(n, n))[..., None]
        radius = parameters[..., 9, None]
        turn = readings[..., None] / radius
        way = np.sin(turn) * t + (1 - np.cos(turn)) * n
        return center + radius * way, np.cos(turn) * t + np.sin(turn) * n
'''
STILL = np.zeros(6)
LEAN = 0.02
"""m along the axis by which the arm's end stands out."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of the carriers' file and the mechanisms; the carriers are registered meanwhile."""
    folder = tmp_path_factory.mktemp("carriers")
    (folder / "my_carriers.py").write_text(CARRIERS)
    sys.path.insert(0, str(folder))
    importlib.import_module("my_carriers")
    yield folder
    sys.path.remove(str(folder))
    del sys.modules["my_carriers"]
    gc.collect()


@pytest.fixture(scope="module")
def machine(folder):
    """The built-in 6-RUS with arms that stand out along their axes; its file is machine.yaml."""
    plain = load_mechanism("6-rus")
    home = plain.home()
    readings = plain.inverse(home)
    ends = limb_ends(plain.layout, plain.values, readings, home)
    document = plain.to_document() | {"name": "leaning"}
    group = plain.layout.base[0]
    at_zero = Crank.place(group.of(plain.values), np.zeros(6))[0]
    for j, leg in enumerate(document["legs"]):
        base, axis = leg["base"], plain.base_axes()[j]
        arm = at_zero[j] - base["center"] + LEAN * axis
        leg["base"] = {key: base[key] for key in ("center", "axis", "range")}
        leg["base"] |= {"joint": "leaning-crank", "arm": arm.tolist()}
        line = ends.b[j] - ends.a[j] - LEAN * axis
        leg["length"]["constant"] = float(np.linalg.norm(line))
    (folder / "machine.yaml").write_text(yaml_text(document))
    return with_forearms(load_mechanism(folder / "machine.yaml"))


@pytest.fixture(scope="module")
def arcs(folder):
    """The built-in linear delta with guides that bend outwards at their upper ends."""
    document = load_mechanism("linear-delta").to_document() | {"name": "arcs"}
    for leg in document["legs"]:
        center = np.array(leg["base"]["center"])
        leg["base"] |= {"joint": "arc", "radius": 2.0, "normal": [*center[:2].tolist(), 0.0]}
    (folder / "arcs.yaml").write_text(yaml_text(document))
    return load_mechanism(folder / "arcs.yaml")


# files


def test_it_is_a_machine_with_the_carriers_parameters(machine, folder):
    own = [n for n in machine.parameters.names if n.startswith("legs[1].base")]
    assert own == [f"legs[1].base.{f}.{c}" for f in ("center", "axis", "arm") for c in "xyz"]
    assert machine.joint_units == ("rad",) * 6
    parts = {cause.part for cause in single_causes(machine)}  # distinguishable by a watch
    assert parts == {"base", "arm", "rod", "platform", "scale"}
    (folder / "again.yaml").write_text(mechanism_text(machine))
    np.testing.assert_array_equal(load_mechanism(folder / "again.yaml").values, machine.values)


def test_faults_of_its_fields_are_reported_as_others_are(machine, folder):
    text = mechanism_text(machine).replace("arm: [", "arms: [", 1)
    (folder / "fault.yaml").write_text(text)
    with raises(InputError, where="fault.yaml, line 8, legs[1].base.arms", found="arms"):
        load_mechanism(folder / "fault.yaml")
    (folder / "fault.yaml").write_text(text.replace("leaning-crank", "leaning", 1))
    with raises(InputError, found="leaning") as caught:
        load_mechanism(folder / "fault.yaml")
    assert {"crank", "leaning-crank"} <= set(caught.value.expected[len("one of ") :].split(", "))


def test_commands_find_it_by_the_environment(machine, folder):
    """``PKMCAL_CARRIERS`` names modules on Python's path."""
    code = "import pkmcal, sys; print(pkmcal.load_mechanism(sys.argv[1]).name)"
    path = os.pathsep.join([str(folder), *sys.path])

    def run(carriers):
        environment = os.environ | {"PYTHONPATH": path, "PKMCAL_CARRIERS": carriers}
        command = [sys.executable, "-c", code, str(folder / "machine.yaml")]
        return subprocess.run(command, env=environment, capture_output=True, text=True)

    assert run("my_carriers").stdout == "leaning\n"
    assert "a module with carriers cannot be imported" in run("no_carriers").stderr


# kinematics


@pytest.mark.parametrize("name", ["leaning-crank", "arc"])
def test_its_defaults_meet_the_contract(folder, name):
    carrier = base_carriers()[name]
    test_carriers.test_base_points_move_with_the_base_frame(carrier, True)
    test_carriers.test_frames_first_order_and_what_errors_become(carrier, True)
    parameters, q = test_carriers.example(carrier, 3), np.linspace(-0.4, 0.4, 4)
    oracle = test_carriers.differences(lambda d: carrier.place(parameters, q + d[0])[0], 1)
    np.testing.assert_allclose(carrier.place(parameters, q)[1], oracle[..., 0], atol=1e-9)
    n = parameters.shape[-1]
    oracle = test_carriers.differences(lambda d: carrier.place(parameters + d, q)[0], n, 1e-3)
    values = carrier.by_parameters(parameters, q)
    np.testing.assert_allclose(values, oracle, atol=1e-7 * np.abs(oracle).max())


def test_defaults_are_what_the_package_s_carriers_give_themselves():
    rng = np.random.default_rng(0)
    for carrier in test_carriers.BASE:
        parameters, q = rng.normal(size=(4, len(carrier.parameters))), rng.normal(size=4)
        default = super(carrier, carrier).by_parameters(parameters, q)
        np.testing.assert_allclose(default, carrier.by_parameters(parameters, q), atol=1e-13)
        # the length of a cable contains what lies on its pulley
        if carrier.driven and not issubclass(carrier, Winding):
            b, near = rng.normal(size=(4, 3)), q + 0.01
            length = np.linalg.norm(b - carrier.place(parameters, q)[0], axis=1)
            values = super(carrier, carrier).reading(parameters, b, length, near)
            np.testing.assert_allclose(
                values, carrier.reading(parameters, b, length, near), atol=1e-7
            )
    T = perturb(np.eye(4), rng.normal(size=(4, 6)))
    for carrier in test_carriers.PLATFORM:
        parameters, phi = rng.normal(size=(4, len(carrier.parameters))), rng.normal(size=4)
        default = super(carrier, carrier).by_parameters(parameters, T, phi)
        np.testing.assert_allclose(default, carrier.by_parameters(parameters, T, phi), atol=1e-13)


def test_forward_and_inverse_agree(machine, arcs):
    rng = np.random.default_rng(0)
    for each in (machine, arcs):
        motion = each.layout.motion
        steps = rng.uniform(-1, 1, (50, 6)) * np.repeat([0.1, 0.01], 3) @ motion @ motion.T
        poses = perturb(each.home(), steps)
        readings = each.inverse(poses)
        np.testing.assert_allclose(each.forward(readings), poses, atol=1e-11)
        assert each.limits().at_home[1] > 0
    far = perturb(machine.home(), np.array([0, 0, 0, 0, 0, 1.0]))
    assert np.isnan(machine.inverse(far)).all()


def oracle(machine, theta, readings, rot, t):
    """The closure by the file's fields, turned by the exponential's own series; may be complex."""
    value = dict(zip(machine.parameters.names, theta, strict=True))
    rows = []
    for j, q in enumerate(readings, start=1):
        center, axis, arm = (
            np.array([value[f"legs[{j}].base.{f}.{c}"] for c in "xyz"])
            for f in ("center", "axis", "arm")
        )
        b = np.array([value[f"legs[{j}].platform.center.{c}"] for c in "xyz"])
        x, y, z = q * axis / np.sqrt(axis @ axis)
        spin = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turned, term = arm, arm
        for k in range(1, 30):
            term = spin @ term / k
            turned = turned + term
        line = rot @ b + t - center - turned
        rows.append(np.sqrt(line @ line) - value[f"legs[{j}].length.constant"])
    return np.array(rows)


def test_jacobians_against_complex_steps(machine):
    rng, steps = np.random.default_rng(1), test_catalogue.complex_steps
    theta = machine.values + 0.01 * rng.normal(size=len(machine.values))
    readings = machine.inverse(machine.home()) + 0.1 * rng.normal(size=6)
    T = perturb(machine.home(), 0.1 * rng.normal(size=6))
    c = closure(machine.layout, theta, readings, T)

    def rows(d_theta=0.0, d_pose=STILL, d_readings=0.0):
        w = d_pose[:3]
        turn = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        rot = T[:3, :3] + turn @ T[:3, :3]
        return oracle(machine, theta + d_theta, readings + d_readings, rot, T[:3, 3] + d_pose[3:])

    close = {"rtol": 1e-12, "atol": 1e-13}
    np.testing.assert_allclose(c.rows.value, rows(), **close)
    by_theta = steps(lambda d: rows(d_theta=d), len(theta))
    np.testing.assert_allclose(dense(c, len(theta)), by_theta, **close)
    np.testing.assert_allclose(c.rows.by_pose, steps(lambda d: rows(d_pose=d), 6), **close)
    by_readings = steps(lambda d: rows(d_readings=d), 6)
    np.testing.assert_allclose(np.diag(c.by_reading), by_readings, **close)


# from a session to a result


@pytest.fixture(scope="module")
def calibrated(machine):
    """Truth of a simulated session of edges, and its estimate."""
    truth, measurements = test_catalogue.simulated(machine, 1, stations=3)
    rough = np.stack([pose.T_camera_base() for pose in truth.rough])
    start = start_state(machine, measurements, rough)
    return truth, measurements, bundle(machine, measurements, start)


def test_a_session_calibrates_to_the_truth(machine, calibrated):
    truth, _, value = calibrated
    z = test_catalogue.whitened(machine, value, truth)
    assert np.mean(z**2) == pytest.approx(1, abs=4 * np.sqrt(2 / z.size))

    def neighbours(reference_values):
        """Lengths (K, 6) between the arms' ends of one leg and the next, which need no frame, m."""
        ends = limb_ends(
            reference_values.layout, reference_values.values, truth.joints, np.eye(4)
        ).a
        return np.linalg.norm(ends - np.roll(ends, 1, axis=-2), axis=-1)

    true = neighbours(truth.machine)
    before, after = (np.abs(neighbours(m) - true).max() for m in (machine, value.machine))
    assert after < before / 5


def test_what_data_leave_open_is_stated(machine, calibrated):
    """A centre may slide along its axis, with the arm sliding back: one direction a leg."""
    _, measurements, estimate = calibrated
    assembled = assemble(machine, measurements, default_gauge(machine))
    info = Information(assembled.problem, batch_of(machine, assembled, estimate.state))
    values = identifiability(info, machine)
    findings = explain(values, estimate, np.ones((3, 6), dtype=bool))
    slides = [sentence for sentence in findings.unidentified if not sentence.matters]
    assert sum(sentence.dimensions for sentence in slides) == 6
    (slide,) = slides
    assert slide.text == (
        "Where on its axis each of legs 1 to 6 has its centre is free. This does not move the "
        "platform."
    )
    for j in range(1, 7):
        for field in ("center", "arm"):
            assert any(n.startswith(f"legs[{j}].base.{field}") for n in slide.parameters)


def test_it_is_drawn(machine, calibrated):
    _, _, estimate = calibrated
    drives = drives_of(machine)
    assert drives.arms.all()
    np.testing.assert_allclose(
        drives.foot, machine.values[machine.layout.base[0].index[:, :3]], atol=1e-15
    )
    np.testing.assert_allclose(np.abs(np.sum(drives.axis * machine.base_axes(), axis=1)), 1)
    np.testing.assert_allclose(drives.arm, np.hypot(0.05, LEAN), atol=1e-6)
    boxes = boxes_of(machine)
    ends = limb_ends(
        machine.layout, machine.values, machine.inverse(machine.home()), machine.home()
    )
    for a, foot in zip(ends.a, drives.foot, strict=True):
        assert any(np.allclose(box.centre, (a + foot) / 2, atol=1e-9) for box in boxes)
    legs = machine_shape(estimate.machine, {}, {}).home.legs
    for leg, foot in zip(legs, drives_of(estimate.machine).foot, strict=True):
        np.testing.assert_allclose(leg.base[0], foot, atol=1e-6)
        assert len(leg.base) == 2


def test_a_way_that_bends_is_drawn_in_pieces(arcs):
    drives = drives_of(arcs)
    assert drives.guides.all()
    for j, attempt in enumerate(drives.ways):
        assert len(attempt) == BENT_GUIDE_PIECES + 1
        from_axis = attempt - arcs.base_centers()[j]
        assert np.ptp(np.linalg.norm(from_axis[:, :2], axis=1)) > 1e-3
    rails = [box for box in boxes_of(arcs) if box.half[1] == box.half[2]]
    assert len(rails) == 3 * BENT_GUIDE_PIECES
    for box in boxes_of(arcs):
        np.testing.assert_allclose(box.rot @ box.rot.T, np.eye(3), atol=1e-12)


def boxes_of(machine):
    """The boxes of a machine at home, as the renderer gets them."""
    finish = Finish.from_noise(SmoothNoise.from_rng(np.random.default_rng(0)))
    home = machine.home()
    parts = machine_parts(machine, discs_of(machine), finish, home, machine.inverse(home))
    return [part.shape for part in parts if isinstance(part.shape, Box)]


# other programs


@pytest.mark.parametrize("target", ["c", "mujoco"])
def test_it_is_exported_as_the_joint_of_its_chain(machine, target):
    made = make_export(source_of(machine), target)
    assert made.files


@pytest.mark.parametrize("target", ["c", "mujoco"])
def test_what_has_no_chain_is_not_exported(arcs, target):
    with raises(InputError, code="export.no_chain", found="arc"):
        make_export(source_of(arcs), target)
