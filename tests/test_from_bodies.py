"""Nominal models from MJCF, SDF, and URDF with loops: pkmcal's own exports, and other files."""

from __future__ import annotations

import os
from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement, fromstring, tostring

import numpy as np
import pytest

import pkmcal
from conftest import run
from faults import raises
from mujoco_machines import ALL, LOUD, machine_of
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import exporters
from pkmcal.exporters.mujoco_read import read_mujoco
from pkmcal.exporters.samples import samples
from pkmcal.exporters.xml_read import LARGEST_MODEL_FILE
from pkmcal.geometry.rigid import (
    from_roll_pitch_yaw,
    pose,
    pose_difference,
    roll_pitch_yaw,
    rotation,
)
from pkmcal.mechanisms import load_mechanism

ROUNDING = 1e-12
"""m and rad; 1.2e-13 was the largest of all machines."""
RADIUS_ROUNDING = 6e-7
"""m, of the radii in a nominal model's file."""
BASE = np.array(
    [[0.3 * np.cos(a), 0.3 * np.sin(a), 0.05] for a in np.deg2rad([-10, 10, 110, 130, 230, 250])]
)
PLATE = np.array(
    [[0.2 * np.cos(a), 0.2 * np.sin(a), -0.01] for a in np.deg2rad([-50, 50, 70, 170, 190, 290])]
)
RAISED = pose(from_roll_pitch_yaw(np.array([0.02, -0.03, 0.1])), np.array([0.01, 0.02, 0.4]))
TOPS = PLATE @ RAISED[:3, :3].T + RAISED[:3, 3]
LENGTHS = np.linalg.norm(TOPS - BASE, axis=1)


def read(path, folder, **given):
    """The machine that a session from a file has, and the text of its mechanism."""
    text = pkmcal.new(from_file=path, **given).texts["mechanism.yaml"]
    (folder / "mechanism.yaml").write_text(text)
    return load_mechanism(folder / "mechanism.yaml"), text


@pytest.mark.parametrize("name", ALL)
def test_what_is_exported_as_xml_is_read_as_the_same_machine(name, tmp_path):
    machine = machine_of(name)
    poses, readings = samples(machine, 8)
    formats = []
    for to, exporter in exporters().items():
        try:
            files = exporter.files(MachineSource(machine))
        except InputError:  # formats of other machines
            continue
        first = next(iter(files))
        if not files[first].startswith("<"):
            continue
        formats.append(to)
        for file, text in files.items():
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).write_text(text, encoding="utf-8")
        model, text = read(tmp_path / first, tmp_path)
        assert model.document.motion == machine.document.motion
        assert model.joint_units == machine.joint_units
        np.testing.assert_allclose(model.inverse(poses), readings, atol=ROUNDING)
        away = pose_difference(model.forward(readings), poses)
        assert np.abs(away).max() < ROUNDING
        np.testing.assert_allclose(model.joint_ranges, machine.joint_ranges, atol=ROUNDING)
        assert "differ" not in text
        for drawn, radii in zip(model.radii(), machine.radii(), strict=True):
            np.testing.assert_allclose(sorted(drawn), sorted(radii), atol=RADIUS_ROUNDING)
    assert {"mujoco", "sdf", "urdf"} <= set(formats)


# ------------------------------------------------------------------ files of other programs


def words(values):
    return " ".join(repr(float(v)) for v in np.ravel(values))


def upright(u):
    """Orientation whose z axis is u."""
    turn = np.cross([0, 0, 1], u)
    return rotation(np.arctan2(np.linalg.norm(turn), u[2]) * turn / np.linalg.norm(turn))


def mjcf():
    """Hexapod with what pkmcal's own export does not use: degrees, Euler angles, default classes,
    joints beside the body's origin, balls, sites, no names, a gripper, motors in another order.
    """
    root = Element("mujoco")
    SubElement(root, "compiler", eulerseq="XYZ")
    main = SubElement(root, "default")
    leg = SubElement(main, "default", {"class": "leg"})
    SubElement(leg, "joint", axis="1 0 0", range="-60 60")
    slide = SubElement(leg, "default", {"class": "rod"})
    SubElement(slide, "joint", type="slide", axis="0 0 -2", range="-0.1 0.05")
    world = SubElement(root, "worldbody")
    base = SubElement(world, "body", name="frame")
    angles = np.rad2deg(roll_pitch_yaw(RAISED[:3, :3]))
    plate = SubElement(world, "body", name="top", pos=words(RAISED[:3, 3]), euler=words(angles))
    SubElement(plate, "freejoint")
    SubElement(SubElement(plate, "body", name="finger"), "joint", name="grip", type="hinge")
    for k, (a, top) in enumerate(zip(BASE, TOPS, strict=True)):
        u = (top - a) / LENGTHS[k]
        turn = np.rad2deg(roll_pitch_yaw(upright(u)))
        down = np.array([0.0, 0.0, -0.1])  # body origin 0.1 m up the leg, its joints at the end
        at = a - upright(u) @ down
        rod = SubElement(base, "body", pos=words(at), euler=words(turn), childclass="leg")
        if k == 5:
            SubElement(rod, "joint", type="ball", pos=words(down), range="0 0", limited="false")
        else:
            SubElement(rod, "joint", pos=words(down))
            SubElement(rod, "joint", pos=words(down), axis="0 1 0")
        piston = SubElement(rod, "body", name=f"piston{k}")
        SubElement(piston, "joint", {"class": "rod"}, name=f"slide{k}", ref="0.02")
        SubElement(piston, "site", name=f"tip{k}", pos=words([0, 0, LENGTHS[k] - 0.1]))
        SubElement(plate, "site", name=f"socket{k}", pos=words(PLATE[k]))
    equality, actuator = SubElement(root, "equality"), SubElement(root, "actuator")
    for k in range(6):
        SubElement(equality, "connect", site1=f"tip{k}", site2=f"socket{k}")
        SubElement(actuator, "motor", joint=f"slide{5 - k}", gear="90")
    SubElement(actuator, "position", joint="grip")
    return root


def sdf():
    """Hexapod of SDF 1.4: axes in the model's frame, joints in any order, each leg's top a ball
    with the platform as its child, nothing on the world, no motors.
    """
    root = Element("sdf", version="1.4")
    model = SubElement(SubElement(root, "world", name="hall"), "model", name="rig")

    def link(name, T):
        node = SubElement(model, "link", name=name)
        SubElement(node, "pose").text = words([*T[:3, 3], *roll_pitch_yaw(T[:3, :3])])

    def joint(name, kind, parent, child, place, *axes):
        node = SubElement(model, "joint", name=name, type=kind)
        SubElement(node, "parent").text, SubElement(node, "child").text = parent, child
        SubElement(node, "pose").text = words([*place, 0, 0, 0])
        for tag, axis in zip(("axis", "axis2"), axes, strict=False):
            SubElement(SubElement(node, tag), "xyz").text = words(axis)

    link("base_link", np.eye(4))
    link("plate", RAISED)
    for k, (a, top) in enumerate(zip(BASE, TOPS, strict=True)):
        u = (top - a) / LENGTHS[k]
        middle = pose(upright(u), (a + top) / 2)
        link(f"shaft{k}", middle)
        link(f"tube{k}", middle)
        joint(f"top{k}", "ball", f"shaft{k}", "plate", PLATE[k])
        joint(f"push{k}", "prismatic", f"tube{k}", f"shaft{k}", [0, 0, 0], u)
        across = np.cross(u, [0, 1, 0])
        half = [0, 0, -LENGTHS[k] / 2]
        joint(f"foot{k}", "universal", "base_link", f"tube{k}", half, [0, 1, 0], across)
    return root


def written(root, folder, name="model.xml"):
    path = folder / name
    path.write_bytes(tostring(root))
    return path


def assert_hexapod(machine, order=range(6)):
    """Centres of the hexapod, and home where it was."""
    order = list(order)
    np.testing.assert_allclose(machine.base_centers(), BASE[order], atol=1e-9)
    np.testing.assert_allclose(machine.platform_centers(), PLATE[order], atol=1e-9)
    np.testing.assert_allclose(machine.home(), RAISED, atol=1e-9)


def test_an_mjcf_of_another_origin(tmp_path):
    machine, text = read(written(mjcf(), tmp_path), tmp_path, tube_radius=0.01)
    assert_hexapod(machine, range(5, -1, -1))
    # the slides count downwards from 0.02, so readings are their values with the other sign
    np.testing.assert_allclose(machine.inverse(machine.home()), -0.02, atol=1e-9)
    np.testing.assert_allclose(machine.joint_ranges, [[-0.05, 0.1]] * 6, atol=1e-9)
    assert "grip" in text
    assert all(leg.tubes[0].radius == 0.01 for leg in machine.document.legs)
    joints = [leg.base.joint for leg in machine.document.legs]
    assert joints == ["spherical"] + ["universal"] * 5


@pytest.mark.parametrize("make", ["mjcf", "sdf"])
def test_cylinders_along_the_legs_are_their_tubes(make, tmp_path):
    """By ends, or by middle and length; others, and those beside a leg, are none."""
    root = {"mjcf": mjcf, "sdf": sdf}[make]()
    if make == "mjcf":
        rods = root.findall("worldbody/body[@name='frame']/body")
        for rod in rods[1:]:  # the origin is 0.1 m up the leg
            SubElement(rod, "geom", type="capsule", size="0.008", fromto="0 0 -0.05 0 0 0.1")
            SubElement(rod, "geom", type="cylinder", size="0.005 0.05", pos="0 0 0.14")
            SubElement(rod, "geom", type="cylinder", size="0.02", fromto="0.01 0 0 0.01 0 0.1")
            SubElement(rod, "geom", size="0.03")
        places = [(0.008, 0.05, 0.2), (0.005, 0.19, 0.29)]
    else:
        for k, length in enumerate(LENGTHS):
            visual = SubElement(root.find(f".//link[@name='shaft{k}']"), "visual", name="v")
            SubElement(visual, "pose").text = f"0 0 {0.15 - length / 2} 0 0 0"
            cylinder = SubElement(SubElement(visual, "geometry"), "cylinder")
            SubElement(cylinder, "radius").text, SubElement(cylinder, "length").text = (
                "0.008",
                "0.2",
            )
        places = [(0.008, 0.05, 0.25)]
    machine, text = read(written(root, tmp_path), tmp_path)
    order = range(5, -1, -1) if make == "mjcf" else range(6)
    for k, leg in zip(order, machine.document.legs, strict=True):
        tubes = [(tube.radius, tube.start, tube.stop) for tube in leg.tubes]
        assert len(tubes) == (0 if make == "mjcf" and k == 0 else len(places))
        if tubes:
            np.testing.assert_allclose(tubes, places, atol=2e-6)
    assert "cylinders" in text
    (tmp_path / "other").mkdir()
    other, _ = read(written(root, tmp_path), tmp_path / "other", tube_radius=0.01)
    assert {tube.radius for leg in other.document.legs for tube in leg.tubes} == {0.01}


def test_mujoco_has_the_bodies_where_they_are_read():
    """At values of all hinges and slides; MuJoCo's order is that of the state."""
    mujoco = pytest.importorskip("mujoco", reason=LOUD)
    root = mjcf()
    for node in root.iter("body"):  # MuJoCo needs masses
        SubElement(node, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
    theirs = mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))
    data, model = mujoco.MjData(theirs), read_mujoco(tostring(mjcf(), encoding="unicode"))
    assert theirs.nv == model.key.size
    x, rng = model.key.copy(), np.random.default_rng(1)
    kinds = {int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)}
    for k in range(theirs.njnt):
        if int(theirs.jnt_type[k]) in kinds:
            value = data.qpos[theirs.jnt_qposadr[k]] + 0.2 * rng.normal()
            data.qpos[theirs.jnt_qposadr[k]] = x[theirs.jnt_dofadr[k]] = value
    assert np.count_nonzero(x != model.key) == 17  # ten hinges, six slides, the gripper
    mujoco.mj_kinematics(theirs, data)
    places = model.places(x)
    names = [theirs.body(k).name for k in range(theirs.nbody)]
    compared = [(k, name) for k, name in enumerate(names) if name]
    assert len(compared) == 10
    for k, name in compared:
        place = pose(data.xmat[k].reshape(3, 3), data.xpos[k])
        np.testing.assert_allclose(places[name], place, atol=1e-12)


REPLICATED = """<mujoco><compiler eulerseq="zyx" angle="{angle}"/><worldbody>
  <body name="plate" pos="0 0 1"><freejoint/><geom size=".1"/>
    <replicate count="3" euler="{turn} 0 0"><site name="socket" pos=".1 0 0"/></replicate></body>
  <frame name="f" pos="0 1 2" euler="{turn} 0 0"><replicate count="10" sep="-" offset="1 0 .2"
    euler=".3 .2 0"><body name="far" pos=".1 0 0"><joint name="j" axis="0 1 0"/><geom size=".1"/>
    <site name="tip" pos="0 0 1"/></body></replicate></frame>
  <replicate count="3" euler="{turn} 0 0"><body name="leg" pos=".2 0 0"><joint name="hip"
    axis="0 1 0"/><geom size=".1"/><replicate count="2" offset="0 .1 0"><body name="toe">
    <joint name="knee"/><geom size=".1"/></body></replicate></body></replicate>
</worldbody><equality><connect body1="leg" anchor="0 0 1"/><joint joint1="knee1" joint2="hip"/>
</equality><actuator><position name="motor" joint="hip"/></actuator></mujoco>"""


@pytest.mark.parametrize(("angle", "turn"), [("degree", "120"), ("radian", "2")])
def test_mujoco_has_the_copies_where_they_are_read(angle, turn):
    mujoco = pytest.importorskip("mujoco", reason=LOUD)
    text = REPLICATED.format(angle=angle, turn=turn)
    theirs, model = mujoco.MjModel.from_xml_string(text), read_mujoco(text)
    data = mujoco.MjData(theirs)
    mujoco.mj_kinematics(theirs, data)
    places, sites = model.places(model.key), model.site_places(model.key)
    assert len(places) == theirs.nbody == 21
    for k in range(theirs.nbody):
        place = pose(data.xmat[k].reshape(3, 3), data.xpos[k])
        np.testing.assert_allclose(places[theirs.body(k).name], place, atol=1e-12)
    assert len(sites) == theirs.nsite
    for k in range(theirs.nsite):
        np.testing.assert_allclose(sites[theirs.site(k).name], data.site_xpos[k], atol=1e-12)
    assert len(model.loops) + len(model.couplings) == theirs.neq
    dofs = [theirs.jnt_dofadr[k] for k in theirs.actuator_trnid[:, 0]]
    np.testing.assert_array_equal(model.actuated, dofs)


def test_an_mjcf_in_several_files(tmp_path):
    """Default classes, constraints and a leg are in files beside it and below."""
    root = mjcf()
    (tmp_path / "parts").mkdir()
    base = root.find("worldbody/body")
    leg = base.find("body")
    for parent, node, name in (
        (root, root.find("equality"), "loops.xml"),
        (root, root.find("default"), "parts/classes.xml"),
        (base, leg, "parts/leg.xml"),
    ):
        at = list(parent).index(node)
        parent[at] = Element("include", file=name)
        (tmp_path / name).write_bytes(b"<mujocoinclude>" + tostring(node) + b"</mujocoinclude>")
    machine, _ = read(written(root, tmp_path), tmp_path)
    assert_hexapod(machine, range(5, -1, -1))


def test_an_sdf_of_another_origin(tmp_path):
    machine, _ = read(written(sdf(), tmp_path, "rig.world"), tmp_path)
    assert_hexapod(machine)
    np.testing.assert_allclose(machine.inverse(machine.home()), 0, atol=1e-9)


def test_the_command_makes_a_session(tmp_path):
    path = written(mjcf(), tmp_path)
    assert run("new", tmp_path / "mine", "--from", path).code == 0
    assert run("new", tmp_path / "other", "--from", path, "--unit", "mm").code == 2
    assert run("new", tmp_path / "other", "--from", path, "--leg", "1 m").code == 2


# ------------------------------------------------------------------ refusals


def changed(make, path, **attributes):
    """A model with other attributes of its first element at a path; None removes one."""
    root = make()
    node = root.find(path)
    for key, value in attributes.items():
        if value is None:
            del node.attrib[key]
        else:
            node.set(key, value)
    return root


def with_text(make, path, text):
    root = make()
    root.find(path).text = text
    return root


REFUSED = {
    "axes that are neither square nor meet": (
        lambda: changed(
            mjcf, ".//body[@name='frame']/body/joint[2]", pos="0 0 -0.103", axis="1 5 0"
        ),
        "mm",
    ),
    "a slide beside the leg": (
        lambda: changed(mjcf, ".//joint[@name='slide0']", axis="0 0.1 1"), "deg"
    ),
    "a tendon": (lambda: changed(mjcf, "actuator/motor", joint=None, tendon="rope"), "rope"),
    "no such class": (lambda: changed(mjcf, ".//joint[@name='slide0']", **{"class": "x"}), "x"),
    "no number": (lambda: changed(mjcf, ".//site", pos="0 zero 0"), "zero"),
    "too large": (lambda: changed(mjcf, ".//site", pos="0 1e200 0"), "1e200"),
    "not finite": (lambda: changed(mjcf, ".//site", pos="0 nan 0"), "nan"),
    "no direction": (lambda: changed(mjcf, ".//joint[@name='slide0']", axis="0 0 0"), "0.0"),
    "no such site": (lambda: changed(mjcf, "equality/connect", site2="nowhere"), "nowhere"),
    "a type of joint": (lambda: changed(sdf, ".//joint", type="screw"), "screw"),
    "two joints of one name": (
        lambda: changed(mjcf, ".//joint[@name='slide0']", name="slide1"), "slide1"
    ),
    "two sites of one name": (lambda: changed(mjcf, ".//site[@name='tip0']", name="tip1"), "tip1"),
    "two links of one name": (
        lambda: changed(sdf, ".//link[@name='tube0']", name="tube1"), "tube1"
    ),
    "no such link": (lambda: with_text(sdf, ".//joint/parent", "nobody"), "nobody"),
}  # fmt: skip


def test_a_template_is_greeted_as_one(tmp_path):
    path = tmp_path / "model.sdf"
    path.write_text("<?xml version='1.0'?>\n<%\n  R = 1.0\n%>\n<sdf version='1.4'/>\n")
    with pytest.raises(InputError) as error:
        read(path, tmp_path)
    assert "<%" in error.value.found
    assert error.value.next_step


def test_a_universal_joint_with_offset_axes_is_read(tmp_path):
    root = changed(mjcf, ".//body[@name='frame']/body/joint[2]", pos="0 0 -0.097")
    machine, _ = read(written(root, tmp_path), tmp_path)
    offsets = [leg["base"].get("offset") for leg in machine.to_document()["legs"]]
    (stated,) = [offset for offset in offsets if offset is not None]
    assert stated == pytest.approx(0.003, abs=1e-6)


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_represented_is_refused_with_what_was_read(what, tmp_path):
    make, fact = REFUSED[what]
    with pytest.raises(InputError) as error:
        read(written(make(), tmp_path), tmp_path)
    assert fact in error.value.found
    assert error.value.where.startswith("model.xml")


@pytest.mark.parametrize(("gear", "scale"), [("1", 1.0), ("1.25", 0.8), ("90", 1.0), ("-1", 1.0)])
def test_a_gear_that_is_no_scale_is_stated(gear, scale, tmp_path):
    """Readings are then the joints' values, not the drives' positions."""
    root = mjcf()
    for motor in root.findall("actuator/motor"):
        motor.tag = "position"
        motor.set("gear", gear)
    machine, text = read(written(root, tmp_path), tmp_path)
    assert machine.to_document()["legs"][0]["scale"] == pytest.approx(scale)
    assert (sum("gears" in line for line in text.splitlines()) > 0) == (gear in ("90", "-1"))


@pytest.mark.parametrize("what", ["a link", "a joint", "a second parent"])
def test_a_urdf_is_a_tree_of_names(what, tmp_path):
    """Elements that would replace others are refused, not dropped."""
    files = exporters()["urdf"].files(MachineSource(machine_of("gough-stewart")))
    tree, loops = files
    root = fromstring(files[tree])
    tag = "link" if what == "a link" else "joint"
    node = deepcopy(root.findall(tag)[-1])
    if what == "a second parent":
        node.set("name", "another")
    root.append(node)
    (tmp_path / loops).write_text(files[loops])
    with pytest.raises(InputError) as error:
        read(written(root, tmp_path, tree), tmp_path)
    child = node.get("name") if what != "a second parent" else node.find("child").get("link")
    assert error.value.found == child


def test_a_model_without_loops_is_refused(tmp_path):
    root = mjcf()
    root.find("equality").clear()
    with pytest.raises(InputError) as error:
        read(written(root, tmp_path), tmp_path)
    assert error.value.where == "model.xml"


def test_a_urdf_needs_its_loops(tmp_path):
    files = exporters()["urdf"].files(MachineSource(machine_of("gough-stewart")))
    tree, loops = files
    (tmp_path / tree).write_text(files[tree])
    with pytest.raises(InputError) as error:
        read(tmp_path / tree, tmp_path)
    assert loops in error.value.found
    (tmp_path / loops).write_text(files[loops].replace("leg4_tip", "leg4_tap"))
    with pytest.raises(InputError) as error:
        read(tmp_path / tree, tmp_path)
    assert error.value.found == "leg4_tap"
    (tmp_path / loops).write_text("loops: 3\n")
    where = f"{tree}: {loops}, line 1, loops"
    with raises(InputError, where=where, found="3"):
        read(tmp_path / tree, tmp_path)


ENTITIES = (
    '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 9)).replace("a0", "a")
    + "]><mujoco>&a8;</mujoco>"
)
LONG = "".join(
    f'<link name="{k}"/><joint name="j{k}" type="ball"><parent>{k + 1}</parent><child>{k}</child>'
    "</joint>"
    for k in range(3000)
)
HOSTILE = {
    "a long chain": f'<sdf version="1.7"><model name="m"><link name="3000"/>{LONG}</model></sdf>',
    "entities": ENTITIES,
    "a file from outside": '<!DOCTYPE m [<!ENTITY f SYSTEM "file:///etc/passwd">]><mujoco>&f;</mujoco>',
    "too deep": "<mujoco><worldbody>"
    + "<body>" * 5000
    + "</body>" * 5000
    + "</worldbody></mujoco>",
    "too many": "<mujoco>" + "<body/>" * 50_000 + "</mujoco>",
    "too large": "<mujoco>" + " " * LARGEST_MODEL_FILE + "</mujoco>",
    "cut off": "<mujoco><worldbody>",
    "another language": "<html><body/></html>",
    "empty": "<mujoco/>",
    "a circle of frames": '<sdf version="1.7"><model name="m">'
    '<link name="a"><pose relative_to="b"/></link><link name="b"><pose relative_to="a"/></link>'
    '<joint name="j" type="fixed"><parent>a'
    "</parent><child>b</child></joint></model></sdf>",
    "a circle of joints": '<sdf version="1.7"><model name="m"><link name="a"/><link name="b"/>'
    '<joint name="j" type="ball"><parent>a</parent><child>b</child></joint><joint name="k"'
    ' type="ball"><parent>b</parent><child>a</child></joint></model></sdf>',
}


NESTED = '<replicate count="100">' * 5 + "<body/>" + "</replicate>" * 5
LONG_WORD = "x" * 100_000
HOSTILE |= {
    f"copies {k}": f"<mujoco><worldbody>{text}</worldbody></mujoco>"
    for k, text in enumerate((
        '<replicate count="1e300"><body/></replicate>',
        '<replicate count="1.5"><body/></replicate>',
        '<replicate count="nan"><body/></replicate>',
        f'<replicate count="500" sep="{LONG_WORD}"><body name="a"/></replicate>',
        f'<replicate count="500"><body name="{LONG_WORD}"/></replicate>',
        NESTED,
    ))
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_xml_is_refused(what, tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(HOSTILE[what])
    result = run("new", tmp_path / "mine", "--from", path)
    assert result.code == 2
    assert not (tmp_path / "mine").exists()


INCLUDED = {
    "part.xml": True, "below/part.xml": True, "./below/../part.xml": True, "inside.xml": True,
    "../model.xml": False, "below/../../model.xml": False, "/etc/passwd": False,
    "outside.xml": False, "out/model.xml": False, "loop.xml": False, "model.xml": False,
    "circle.xml": False, "entities.xml": False, "pipe.xml": False, ".": False, "": False,
    "nothing.xml": False, "a/" * 5000: False, "a" * 5000: False,
}  # fmt: skip


@pytest.mark.parametrize("name", INCLUDED)
def test_files_are_included_from_beside_the_document_alone(name, tmp_path):
    """Every file but the hostile ones is a whole hexapod, so that it is read where it may be."""
    folder = tmp_path / "folder"
    (folder / "below").mkdir(parents=True)
    for path in (tmp_path / "model.xml", folder / "part.xml", folder / "below" / "part.xml"):
        written(mjcf(), path.parent, path.name)
    (folder / "entities.xml").write_text(ENTITIES)
    (folder / "circle.xml").write_text('<a><include file="circle.xml"/></a>')
    (folder / "inside.xml").symlink_to("part.xml")
    (folder / "outside.xml").symlink_to(tmp_path / "model.xml")
    (folder / "out").symlink_to(tmp_path)
    (folder / "loop.xml").symlink_to("loop.xml")
    os.mkfifo(folder / "pipe.xml")
    (folder / "model.xml").write_text(f'<mujoco><include file="{name}"/></mujoco>')
    result = run("new", tmp_path / "mine", "--from", folder / "model.xml")
    assert (result.code == 0) == INCLUDED[name]
    assert INCLUDED[name] or result.err.startswith("Error: model.xml")
    assert (tmp_path / "mine").exists() == INCLUDED[name]


def test_a_file_is_included_once(tmp_path):
    (tmp_path / "part.xml").write_text("<a><size/></a>")
    root = mjcf()
    for name in ("part.xml", "./part.xml"):
        root.append(Element("include", file=name))
        path = written(root, tmp_path)
        assert run("new", tmp_path / name[0], "--from", path).code == (0 if name[0] == "p" else 2)


def test_a_xacro_is_refused_with_its_way_out(tmp_path):
    path = tmp_path / "robot.urdf.xacro"
    path.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:property name="a" value="1"/><link name="base"/></robot>'
    )
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=path)
    assert refused.value.where == path.name
    assert "xacro" in refused.value.next_step


@pytest.mark.parametrize(
    ("name", "element", "attribute", "value"),
    [
        # a universal joint whose second axis is not square to the leg restricts its twist otherwise
        ("3-upu", ".//joint[@name='leg1_base_second']", "axis", "0.1 0.7 0.7"),
        # bars that turn back by less than the platform turns
        ("h4", "equality/joint", "polycoef", "0 -0.9 0 0 0"),
    ],
)
def test_a_model_that_moves_otherwise_is_refused(name, element, attribute, value, tmp_path):
    (text,) = exporters()["mujoco"].files(MachineSource(machine_of(name))).values()
    root = fromstring(text)
    root.find(element).set(attribute, value)
    with pytest.raises(InputError) as error:
        read(written(root, tmp_path), tmp_path)
    assert "size" in error.value.found
