"""MuJoCo models: loaded in MuJoCo and held against our kinematics, and read again without it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from faults import raises
from mujoco_machines import ALL, CATALOGUE, LOUD, MADE, TURNED, Simulated, machine_of, made
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import GeometryError, InputError
from pkmcal.exporters.contract import exporters
from pkmcal.exporters.home import home_state
from pkmcal.exporters.mujoco_read import read_mujoco
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms import catalogue
from pkmcal.mechanisms.carriers.crank import Crank
from pkmcal.mechanisms.carriers.joint import RigidPlatform
from pkmcal.mechanisms.kinematics import forward
from pkmcal.simulation.truth import true_machine

PLACE, TURN = 1e-12, 1e-11
"""m, rad: 4e-14 and 3e-13 were the largest of twenty readings a machine."""


def exported(machine, **of):
    source = MachineSource(machine, origin="a test", **of)
    value = exporters()["mujoco"].files(source)
    ((name, text),) = value.items()
    assert name.endswith(".xml")
    return source, text


def differences(source, text):
    return exporters()["mujoco"].check({"m.xml": text}, source)


def reachable(machine, readings, pieces=12):
    """Goals among readings (n, m), and their poses (4, 4), to which the machine can go from home
    along a straight line; some of the H4's leave the workspace on the way.
    """
    begin = home_state(machine).readings
    share = np.linspace(0, 1, pieces + 1)[:, None]
    layout, retained = machine.layout, []
    for goal in readings:
        at, good = machine.home(), True
        for q in begin + share * (goal - begin):
            step = forward(layout, machine.values, q, at)
            at, good = step.T_base_platform, good and bool(step.converged)
            good = good and float(step.singularity) > 0.03
        if good:
            retained.append((goal, at))
    return retained


# ------------------------------------------------------------------ in MuJoCo


@pytest.mark.parametrize("name", ALL)
def test_forward_kinematics_are_mujocos(name):
    machine = machine_of(name)
    _, text = exported(machine)
    simulated = Simulated(text)
    goals = reachable(machine, samples(machine, 5, seed=3)[1])
    assert len(goals) >= 3
    for readings, T in goals:
        simulated.home()
        away = np.abs(pose_difference(simulated.drive(readings), T))
        assert np.abs(simulated.closure()[0]).max() < PLACE
        assert away[3:].max() < PLACE
        assert away[:3].max() < TURN


@pytest.mark.parametrize("name", [*CATALOGUE, *MADE, *TURNED])
def test_home_is_closed_and_nothing_spins(name):
    machine = machine_of(name)
    _, text = exported(machine)
    simulated = Simulated(text)
    value, by = simulated.closure()
    assert np.abs(value).max() < 1e-15
    assert np.array_equal(simulated.model.qpos0, simulated.data.qpos)
    assert np.abs(pose_difference(simulated.pose(), home_state(machine).T_base_platform)).max() < (
        1e-14
    )
    # what the loops leave free are the drives, and nothing else
    assert simulated.model.nv - np.linalg.matrix_rank(by, tol=1e-6) == (
        machine.n_joints - machine.redundancy
    )
    free = np.setdiff1d(np.arange(simulated.model.nv), simulated.dofs)
    assert np.linalg.svd(by[:, free], compute_uv=False)[free.size - 1] > 1e-3


@pytest.mark.parametrize("name", CATALOGUE)
def test_position_control_settles_at_our_pose(name):
    machine = machine_of(name)
    _, text = exported(machine)
    simulated = Simulated(text)
    goal, T = reachable(machine, samples(machine, 5, seed=3)[1])[0]
    far = np.linalg.norm(T[:3, 3] - simulated.pose()[:3, 3])
    simulated.data.ctrl[:] = goal
    for _ in range(1000):
        simulated.mj.mj_step(simulated.model, simulated.data)
    away = np.abs(pose_difference(simulated.pose(), T))
    assert far > 0.005
    # No weight loads the loops' springs, so only what has not died away remains: the 3-UPU, whose
    # turn is weakly held, has 0.4 um and 4 urad left after a second, the others rounding.
    slow = name == "3-upu"
    assert away[3:].max() < (2e-6 if slow else 1e-11)
    assert away[:3].max() < (2e-5 if slow else 1e-10)


def test_the_example_of_the_page_works(tmp_path, monkeypatch):
    pytest.importorskip("mujoco", reason=LOUD)
    page = Path(__file__).resolve().parents[1] / "docs" / "mujoco.md"
    (code,) = re.findall(
        r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    machine = machine_of("gough-stewart")
    (tmp_path / "gough-stewart.xml").write_text(exported(machine)[1], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    space = {}
    exec(code, space)
    T = machine.forward(space["goal"][None])[0]
    assert np.abs(space["data"].body("platform").xpos - T[:3, 3]).max() < 1e-9


def test_drives_and_sensors_are_the_readings():
    machine = machine_of("wrong gough-stewart")
    simulated = Simulated(exported(machine)[1])
    model, home = simulated.model, home_state(machine)
    names = [model.actuator(k).name for k in range(model.nu)]
    assert names == [f"leg{j + 1}" for j in range(6)]
    simulated.home()
    at_home = [simulated.data.sensor(name).data[0] for name in names]
    assert np.allclose(at_home, home.readings, atol=1e-15)
    assert np.allclose(simulated.data.ctrl, home.readings, atol=1e-15)
    assert np.array_equal(model.actuator_ctrlrange, machine.joint_ranges)
    place = simulated.data.sensor("platform_position").data
    assert np.allclose(place, home.T_base_platform[:3, 3], atol=1e-15)
    rows = [machine.parameters.index(f"legs[{j + 1}].scale") for j in range(6)]
    assert np.abs(machine.values[rows] - 1).max() > 1e-4
    # a joint has what its rod's length is but for the offset, an actuator the reading
    values = [simulated.data.joint(name).qpos[0] for name in names]
    assert np.allclose(values, machine.values[rows] * at_home, atol=1e-15)
    offsets = [home.distance[j] - values[j] for j in range(6)]
    index = [machine.parameters.index(f"legs[{j + 1}].length.offset") for j in range(6)]
    assert np.allclose(offsets, machine.values[index], atol=1e-15)


# ------------------------------------------------------------------ read again, without MuJoCo


@pytest.mark.parametrize("name", ALL)
def test_the_text_read_again_agrees(name):
    source, text = exported(machine_of(name))
    count = differences(source, text)
    assert len(count) == 8
    assert not [d for d in count if d.beyond]


WRONG = {
    "joint centres on the base": r'(<body name="leg2_rod" pos=")[^ ]+',
    "joint centres on the platform": r'(<site name="leg2_platform" pos=")[^ ]+',
    "ends of the rods": r'(<body name="leg1_piston" pos=")[^ ]+',
    "loops at home": r'(<key name="home" qpos="(?:[^ ]+ ){8})[^ ]+',
    "readings at home": r'(<key name="home" qpos=".*ctrl=")[^ ]+',
    "radii": r'(<geom type="cylinder" [^>]*size=")[^"]+(?="[^>]*name="leg3_tube1")',
    "place": r'(<connect name="leg4" [^>]*anchor=")[^ ]+',
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_number_in_the_text_is_found(what):
    source, text = exported(machine_of("gough-stewart"))
    wrong, count = re.subn(WRONG[what], r"\g<1>0.123", text, count=1)
    assert count == 1
    assert any(what in d.what for d in differences(source, wrong) if d.beyond)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("gough-stewart", 'ref="0.415"', 'ref="0.4151"'),
        ("delta", 'axis="-1.0 0.0 0.0" ref', 'axis="-1.0 0.001 0.0" ref'),
        ("h4", 'polycoef="0 -1 0 0 0"', 'polycoef="0 -0.99 0 0 0"'),
    ],
)
def test_joints_that_move_another_way_are_found(name, old, new):
    source, text = exported(machine_of(name))
    assert old in text
    value = differences(source, text.replace(old, new, 1))
    assert any("platform's" in d.what for d in value if d.beyond)


@pytest.mark.parametrize("name", ["3-upu", "h4", "h4-rods", "3-spr", "rpr-and-spu"])
def test_what_is_read_again_closes_from_beside(name):
    model = read_mujoco(exported(machine_of(name))[1])
    rng = np.random.default_rng(0)
    away = model.key + 0.1 * rng.normal(size=(3, model.key.size))
    assert np.abs(model.gaps(away)).max(axis=1).min() > 1e-3
    valid = model.closed(away, np.zeros(model.key.size, dtype=bool))
    assert np.abs(model.gaps(valid)).max() < 1e-13
    assert np.abs(valid - away).max() > 1e-3


# ------------------------------------------------------------------ words and refusals


def test_the_header_states_what_it_is():
    nominal = machine_of("delta")
    _, text = exported(nominal)
    assert "Nominal model only" in text
    assert "a test" in text
    sigma = np.full(len(nominal.parameters), 1.5e-5)
    _, values = exported(
        nominal, sigma=sigma, calibrated=True, headline="Better than the nominal model."
    )
    header = values.partition("<mujoco")[0]
    for word in ("Better than the nominal model.", "sigma 1.5e-05 m", "T_base_platform",
                 "PLACEHOLDERS", "legs[3].length.constant = 0.22 m"):  # fmt: skip
        assert word in header
    assert exporters()["mujoco"].notes(MachineSource(nominal))


def test_a_name_cannot_break_the_text():
    machine = machine_of("delta")
    document = machine.document.model_copy(update={"name": 'a --> <b> "c" \x07 & d-'})
    source, text = exported(replace(machine, document=document))
    assert fromstring(text).get("model") == 'a - -> <b> "c" \\x07 & d- '
    assert not [d for d in differences(source, text) if d.beyond]
    assert list(exporters()["mujoco"].files(source)) == ["a------b---c------d.xml"]


def test_everything_is_named():
    root = fromstring(exported(machine_of("h4-rods"))[1])
    drives = [node.attrib["name"] for node in root.iterfind("actuator/position")]
    assert drives == ["motor1", "motor2", "motor3", "motor4"]
    bodies = {node.attrib["name"] for node in root.iter("body")}
    assert {"platform", "bar1", "bar2", "motor1_crank", "leg8_rod"} <= bodies
    loops = [node.attrib["name"] for node in root.iterfind("equality/connect")]
    assert loops == [f"leg{j + 1}" for j in range(8)]


def test_a_machine_without_ranges_has_no_limits():
    text = re.sub(r", range: \[[^\]]*\]", "", catalogue()["delta"].read_text(encoding="utf-8"))
    source, model = exported(made(text))
    assert "limited" not in model
    assert not [d for d in differences(source, model) if d.beyond]


def values_with(machine, **change):
    values = machine.values.copy()
    for name, amount in change.items():
        leg, path = name.split("__", 1)
        values[machine.parameters.index(f"legs[{leg[3:]}].{path.replace('__', '.')}")] += amount
    return machine.with_values(values)


def test_legs_on_one_motor_with_two_axes_are_refused():
    machine = values_with(machine_of("h4-rods"), leg2__base__center__x=1e-4)
    with raises(InputError, code="export.motor_axes", where="h4-rods") as caught:
        exported(machine)
    assert caught.value.what.startswith("legs 1 and 2 ")


def test_legs_on_one_bar_with_two_hinges_are_refused():
    machine = values_with(machine_of("h4-rods"), leg7__platform__hinge__y=1e-4)
    with raises(InputError, code="export.bar_hinges", where="h4-rods") as caught:
        exported(machine)
    assert caught.value.what.startswith("leg 7 ")


def test_poses_far_from_home_are_read_again():
    """Rods of two legs on one motor, 2 mm off, tilt the H4's nacelle by tens of degrees."""
    machine = true_machine(machine_of("h4-rods"), 1.0, np.random.default_rng(2))
    source, text = exported(machine)
    assert not any(one.beyond for one in differences(source, text))


def test_a_machine_that_does_not_close_is_refused():
    machine = machine_of("delta")
    far = machine.document.home.model_copy(update={"position": (0.0, 0.0, -2.0)})
    document = machine.document.model_copy(update={"home": far})
    with raises(GeometryError, code="mechanism.home_not_closed"):
        exported(replace(machine, document=document))


@pytest.mark.parametrize(("carrier", "side"), [(Crank, "base"), (RigidPlatform, "platform")])
def test_joints_that_are_not_elementary_are_refused(carrier, side, monkeypatch):
    monkeypatch.setattr(carrier, "chain", lambda parameters: None)
    machine = machine_of("delta")
    joint = getattr(machine.document.legs[0], side).joint
    with raises(InputError, code="export.no_chain", found=joint):
        exported(machine)
