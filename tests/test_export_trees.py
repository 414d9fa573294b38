"""URDF and SDF: read by other programs, and again by pkmcal; statements of what they
cannot hold.
"""

from __future__ import annotations

import re
from functools import cache
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest
import yaml
from scipy.linalg import expm

from export_sources import built, calibration
from mujoco_machines import ALL, CATALOGUE, LOUD, MADE, TURNED, machine_of, made
from pkmcal.calibration.machine_source import MachineSource, load_source
from pkmcal.exporters import sdf_read, urdf_read
from pkmcal.exporters.contract import exporters
from pkmcal.exporters.home import home_state
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import from_roll_pitch_yaw, pose, roll_pitch_yaw, rotation, skew
from pkmcal.mechanisms import catalogue

CLOSED = 1e-9
"""m and rad, of joint values that were solved to 1e-12; 8e-14 was the largest of all machines."""
READERS = {
    "urdf": lambda files: urdf_read.read_urdf(*files.values()),
    "sdf": lambda files: sdf_read.read_sdf(*files.values()),
}


@cache
def exported(name, to):
    """A machine's source, its files in a format, and these read again."""
    source = MachineSource(machine_of(name), origin="a test")
    files = exporters()[to].files(source)
    return source, files, READERS[to](files)


def solved(model, machine):
    """States (n, d) of a model closed at poses (n, 4, 4) of a machine."""
    poses, readings = samples(machine, 4, seed=7)
    return model.at(readings, poses), poses


# ------------------------------------------------------------------ URDF, in MuJoCo's own reader


def in_mujoco(text):
    """A URDF in MuJoCo, which needs masses and therefore gets some."""
    mujoco = pytest.importorskip("mujoco", reason=LOUD)
    retained = '<compiler fusestatic="false" boundmass="0.001" boundinertia="0.001" />'
    text = re.sub(r"(<robot [^>]*>)", rf"\1<mujoco>{retained}</mujoco>", text, count=1)
    model = mujoco.MjModel.from_xml_string(text)
    return mujoco, model, mujoco.MjData(model)


def closed_in_mujoco(text, model, x):
    """Poses by link, as MuJoCo has them at the joints' values."""
    mujoco, theirs, data = in_mujoco(text)
    values = {name: x[dof] for name, dof in model.names.items()}
    assert len(values) == theirs.nq
    for name, value in values.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(theirs, data)
    names = [theirs.body(k).name for k in range(theirs.nbody)]
    return {n: pose(data.body(n).xmat.reshape(3, 3), data.body(n).xpos) for n in names}


def assert_closed_in_mujoco(files, model, machine):
    text, loops = files.values()
    states, poses = solved(model, machine)
    assert len(poses) >= 2
    for x, T in zip(states, poses, strict=True):
        values = closed_in_mujoco(text, model, x)
        assert np.abs(values["platform"] - T).max() < CLOSED
        for loop in yaml.safe_load(loops)["loops"]:
            first, second = (values[name] for name in loop["frames"])
            off = first - second if loop["coincide"] == "pose" else (first - second)[:3, 3]
            assert np.abs(off).max() < CLOSED


@pytest.mark.parametrize("name", ALL)
def test_a_urdf_closes_in_mujocos_reader(name):
    source, files, model = exported(name, "urdf")
    assert_closed_in_mujoco(files, model, source.machine)


def test_a_calibrations_urdf_closes_in_mujocos_reader(tmp_path):
    source = load_source(calibration(tmp_path, built("gough-stewart")))
    files = exporters()["urdf"].files(source)
    assert "Calibrated: well." in files["gough-stewart.urdf"]
    assert "sigma" in files["gough-stewart.urdf"]
    model = READERS["urdf"](files)
    assert_closed_in_mujoco(files, model, source.machine)
    # what is read is what was calibrated, not what was drawn
    x, _ = solved(model, source.machine)
    ends = model.site_places(x[0])
    np.testing.assert_allclose(ends["leg2_base"], source.machine.base_centers()[1], atol=1e-15)


@pytest.mark.parametrize("name", catalogue())
def test_home_stands_in_the_loops_file(name):
    source, files, model = exported(name, "urdf")
    beside = yaml.safe_load(files[f"{name}.loops.yaml"])
    home = home_state(source.machine)
    x = np.zeros(model.key.size)
    for joint, dof in model.names.items():
        x[dof] = beside["home"].get(joint, np.nan)
    follows = {c.follower for c in model.couplings}
    assert set(np.flatnonzero(np.isnan(x))) == follows
    np.testing.assert_array_equal([r["home"] for r in beside["readings"]], home.readings)
    if not follows:
        T = closed_in_mujoco(files[f"{name}.urdf"], model, x)["platform"]
        assert np.abs(T - home.T_base_platform).max() < 1e-14


def test_a_urdf_is_one_a_robot_state_publisher_takes():
    """One root, each link held once, and the elements that the specification requires for each
    type.
    """
    _, files, _ = exported("h4", "urdf")
    root = fromstring(files["h4.urdf"])
    links = [node.attrib["name"] for node in root.findall("link")]
    joints = root.findall("joint")
    children = [node.find("child").attrib["link"] for node in joints]
    assert len(set(links)) == len(links)
    assert len({node.attrib["name"] for node in joints}) == len(joints)
    assert sorted(set(links) - set(children)) == ["base"]
    assert len(set(children)) == len(children)
    limited = [n for n in joints if n.attrib["type"] in ("prismatic", "revolute")]
    assert {"leg1", "platform_x"} <= {n.attrib["name"] for n in limited}
    for node in limited:
        assert {"lower", "upper", "effort", "velocity"} == set(node.find("limit").attrib)
    assert not list(root.iter("inertial"))
    followers = {n.attrib["name"] for n in joints if n.find("mimic") is not None}
    assert followers == {"bar1_turn", "bar2_turn"}


# ------------------------------------------------------------------ SDF, by screws


class Drawn:
    """An SDF model by screws in its own frame: no chain of frames, nothing of our reader."""

    def __init__(self, text):
        model = fromstring(text)[0]
        self.links = {n.attrib["name"]: n for n in model.findall("link")}
        self.frames = {n.attrib["name"]: n for n in model.findall("frame")}
        self.joints = {n.attrib["name"]: n for n in model.findall("joint")}
        self.readings = [dict(n.attrib) for n in model.findall("{urn:pkmcal}reading")]

    def at(self, name):
        """Pose (4, 4) of a visual."""
        node = self.links[name] if name in self.links else self.frames[name]
        values = node.find("pose")
        if values is None:
            return np.eye(4)
        above = values.get("relative_to") or node.get("attached_to")
        v = np.array(values.text.split(), dtype=float)
        own = pose(from_roll_pitch_yaw(v[3:]), v[:3])
        return own if above is None else self.at(above) @ own

    def screws(self, name):
        """(4, 4) generators of a joint's axes, in the model's frame as drawn."""
        node = self.joints[name]
        values = node.find("pose")
        frame = node.findtext("child") if values is None else values.get("relative_to")
        T = self.at(frame)
        for tag in ("axis", "axis2"):
            xyz = node.find(f"{tag}/xyz")
            if xyz is None:
                continue
            axis = np.array(xyz.text.split(), dtype=float)
            if xyz.get("expressed_in") is None:
                axis = T[:3, :3] @ axis
            out = np.zeros((4, 4))
            if node.get("type") == "prismatic":
                out[:3, 3] = axis
            else:
                out[:3, :3] = skew(axis)
                out[:3, 3] = np.cross(T[:3, 3], axis)
            yield out

    def moved(self, link, values, platform):
        """Motion (4, 4) of a link from its drawn pose; values by joint, a list each."""
        if link == "world":
            return np.eye(4)
        for name, node in self.joints.items():
            if node.findtext("child") == link and not name.endswith("_loop"):
                out = self.moved(node.findtext("parent"), values, platform)
                for screw, value in zip(self.screws(name), values.get(name, ()), strict=True):
                    out = out @ expm(value * screw)
                return out
        assert link == "platform"
        return platform @ np.linalg.inv(self.at(link))


@pytest.mark.parametrize("name", ALL)
def test_an_sdf_closes_by_screws(name):
    source, files, model = exported(name, "sdf")
    (text,) = files.values()
    drawn = Drawn(text)
    states, poses = solved(model, source.machine)
    assert len(poses) >= 2
    for x, T in zip(states[:2], poses[:2], strict=True):
        values = {}
        for body in model.bodies:
            for j in body.joints:
                if j.kind != "free":
                    values.setdefault(j.name, []).append(x[j.dof] - j.ref)
        results = {link: drawn.moved(link, values, T) for link in drawn.links}
        assert np.abs(results["platform"] @ drawn.at("platform") - T).max() < CLOSED
        loops = [n for n in drawn.joints if n.endswith("_loop")]
        assert len(loops) == source.machine.n_legs
        for loop in loops:
            node = drawn.joints[loop]
            parent, child = (results[node.findtext(end)] for end in ("parent", "child"))
            anchor = drawn.at(node.find("pose").get("relative_to"))[:, 3]
            assert np.abs(parent @ anchor - child @ anchor).max() < CLOSED
            own = parent
            for screw, value in zip(drawn.screws(loop), values.get(loop, ()), strict=False):
                own = own @ expm(value * screw)
            if node.get("type") != "ball":
                assert np.abs(own - child).max() < CLOSED
    # the readings in the text are those of these poses
    readings = source.machine.inverse(poses)
    for k, items in enumerate(drawn.readings):
        home, scale = float(items["home"]), float(items["scale"])
        dof = model.actuated[k]
        assert np.abs(states[:, dof] - scale * readings[:, k]).max() < CLOSED
        assert abs(model.key[dof] - scale * home) < 1e-15


def test_an_sdf_declares_the_lowest_version_that_has_what_it_uses():
    """By SDFormat's list of changes; readers refuse models of later versions than their own."""
    first = {"relative_to": "1.7", "attached_to": "1.7", "expressed_in": "1.7", "mimic": "1.11"}
    later = {"rotation_format", "degrees", "merge", "placement_frame"}  # of 1.8 and later
    actual_names = set()
    for name in ("gough-stewart", "3-rps", "h4-rods", "h4", "linear-delta"):
        (text,) = exported(name, "sdf")[1].values()
        root = fromstring(text)
        words = {node.tag for node in root.iter()} | {
            k for node in root.iter() for k in node.attrib
        }
        assert not words & later
        expected = max((first[word] for word in words & set(first)), key=lambda v: int(v[2:]))
        assert root.get("version") == expected
        actual_names.add(expected)
    assert actual_names == {"1.7", "1.11"}


def test_an_sdf_names_everything_once():
    for name in [*CATALOGUE, *MADE, *TURNED]:
        (text,) = exported(name, "sdf")[1].values()
        model = fromstring(text)[0]
        names = [n.attrib["name"] for n in model if "name" in n.attrib]
        assert len(set(names)) == len(names)
        assert not [n for n in names if "__" in n or "::" in n]


def test_an_sdfs_motors_are_those_that_have_an_effort():
    (text,) = exported("6-spu-passive", "sdf")[1].values()
    model = fromstring(text)[0]
    free = [j.get("name") for j in model.findall("joint") if not j.findall("*/limit/effort")]
    assert [n for n in free if n.startswith("leg") and not n.endswith("_loop")] == [
        f"leg{k}" for k in range(1, 7)
    ]
    limit = next(j for j in model.findall("joint") if j.get("name") == "leg1").find("axis/limit")
    machine = machine_of("6-spu-passive")
    reach = machine.joint_ranges[0] - home_state(machine).readings[0]
    results = [float(limit.findtext(end)) for end in ("lower", "upper")]
    np.testing.assert_allclose(results, reach, atol=1e-15)


# ------------------------------------------------------------------ both, read again


@pytest.mark.parametrize("to", READERS)
@pytest.mark.parametrize("name", ALL)
def test_the_text_read_again_agrees(name, to):
    source, files, _ = exported(name, to)
    count = exporters()[to].check(files, source)
    assert len(count) == 8
    assert not [d for d in count if d.beyond]


WRONG = {
    "urdf": {
        "joint centres on the base": r'(name="leg2_base_first"[^>]*>\s*<origin xyz=")[^ ]+',
        "joint centres on the platform": r'(name="leg2_platform_fixed"[^>]*>\s*<origin xyz=")[^ ]+',
        "ends of the rods": r'(name="leg1_tip_fixed"[^>]*>\s*<origin xyz=")[^ ]+',
        "loops at home": r"(platform_yaw: )[^,]+",
        "readings at home": r"(joint: leg3, scale: [^,]+, home: )[^}]+",
        "radii": r'(<visual name="leg3_tube1">(?:(?!radius=).)*radius=")[^"]+',
        "platform's place": r"(joint: leg3, scale: )[^,]+",
    },
    "sdf": {
        "joint centres on the base": r'(name="leg2_rod">\s*<pose relative_to="base">)[^ ]+',
        "joint centres on the platform": r'(name="leg2_platform"[^>]*>\s*<pose>)[^ ]+',
        "ends of the rods": r'(name="leg1_piston">\s*<pose relative_to="leg1_rod">)[^ ]+',
        "platform's turn": r'(pkmcal:reading joint="leg3" home=")[^"]+',
        "radii": r'(<visual name="leg3_tube1">(?:(?!<radius>).)*<radius>)[^<]+',
        "platform's place": r'(pkmcal:reading joint="leg3" home="[^"]+" scale=")[^"]+',
    },
}


@pytest.mark.parametrize(("to", "what"), [(to, what) for to in WRONG for what in WRONG[to]])
def test_a_wrong_number_is_found(to, what):
    source, files, _ = exported("gough-stewart", to)
    spoilt = {}
    for name, text in files.items():
        spoilt[name] = re.sub(WRONG[to][what], r"\g<1>0.123", text, count=1, flags=re.DOTALL)
    assert spoilt != files
    value = exporters()[to].check(spoilt, source)
    assert any(what in d.what for d in value if d.beyond)


@pytest.mark.parametrize(
    ("to", "old", "new"),
    [
        ("urdf", 'multiplier="-1"', 'multiplier="-0.99"'),
        ("sdf", "<multiplier>-1<", "<multiplier>-0.99<"),
    ],
)
def test_a_bar_that_turns_another_way_is_found(to, old, new):
    source, files, _ = exported("turned h4", to)
    wrong = {name: text.replace(old, new, 1) for name, text in files.items()}
    assert wrong != files
    assert any(d.beyond for d in exporters()[to].check(wrong, source))


# ------------------------------------------------------------------ words


@pytest.mark.parametrize("to", READERS)
def test_what_is_not_known_is_stated(to):
    source, files, _ = exported("delta", to)
    text = next(iter(files.values()))
    flat = " ".join(text.split())
    assert "Nominal model only, not calibrated." in flat
    assert "NOT KNOWN: masses and inertias" in flat
    assert "<inertial" not in text
    values = " ".join(note.text for note in exporters()[to].notes(source))
    assert "images weigh nothing" in values
    assert {"urdf": "A URDF is a tree", "sdf": "may leave them open"}[to] in values


@pytest.mark.parametrize("to", READERS)
def test_a_machine_without_ranges_has_no_limits_of_its_motors(to):
    text = re.sub(r", range: \[[^\]]*\]", "", catalogue()["delta"].read_text(encoding="utf-8"))
    source = MachineSource(made(text), origin="a test")
    files = exporters()[to].files(source)
    tree = fromstring(next(iter(files.values())))
    (motor,) = (n for n in tree.iter("joint") if n.get("name") == "leg1" and len(n))
    assert motor.get("type") == {"urdf": "continuous", "sdf": "revolute"}[to]
    assert not list(motor.iter("lower"))
    assert not [n for n in motor.iter("limit") if n.attrib]
    assert not [d for d in exporters()[to].check(files, source) if d.beyond]


@pytest.mark.parametrize("straight", [False, True])
def test_roll_pitch_yaw_is_the_rotation(straight):
    rng = np.random.default_rng(3)
    for _ in range(50):
        rot = rotation(3 * rng.normal(size=3))
        if straight:  # straight up or down: yaw and roll cannot be separated
            angles = rng.uniform(-3, 3, 3)
            angles[1] = rng.choice([-1, 1]) * np.pi / 2
            rot = from_roll_pitch_yaw(angles)
        angles = roll_pitch_yaw(rot)
        assert abs(angles[1]) <= np.pi / 2
        np.testing.assert_allclose(from_roll_pitch_yaw(angles), rot, atol=3e-16 * 8)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(roll_pitch_yaw(quarter), [0, 0, np.pi / 2], atol=1e-16)
