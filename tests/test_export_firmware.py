"""Settings of firmwares: ideal deltas are recovered, errors of others reported, formulas of
programs.
"""

from __future__ import annotations

import re
from configparser import ConfigParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from export_sources import built, calibration, source_of
from pkmcal.calibration.machine_source import load_source
from pkmcal.errors import InputError
from pkmcal.exporters import linuxcnc
from pkmcal.exporters.contract import exporters, make_export
from pkmcal.exporters.delta import DEGREES_A_RADIAN, Freedoms, delta_of, nearest_fit
from pkmcal.exporters.linuxcnc import linear_joints, rotary_joints
from pkmcal.exporters.samples import samples
from pkmcal.firmware import klipper, reprap
from pkmcal.firmware.contract import firmware_of, firmwares
from pkmcal.geometry.rigid import rotation
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.outcome import Level

FIRMWARES = ("reprap", "klipper", "marlin")
SMALL = np.array([0.004, -0.003, 0.002])


def put(machine, leg, **values):
    """A machine's values with some of one leg's changed: paths with __ for a dot."""
    out = machine.values.copy()
    for path, value in values.items():
        name = f"legs[{leg}].{path.replace('__', '.')}"
        if np.ndim(value):
            k = machine.parameters.index(f"{name}.x")
            out[k : k + 3] = value
        else:
            out[machine.parameters.index(name)] = value
    return machine.with_values(out)


def ideal_linear(radius=0.11, angles=(211.0, 328.5, 90.7), rods=(0.27, 0.2712, 0.2695)):
    """Parallel towers on a circle, in a base frame that is tilted and shifted."""
    machine, tilt = load_mechanism("linear-delta"), rotation(SMALL)
    for leg, (angle, rod) in enumerate(zip(angles, rods, strict=True), start=1):
        out = np.array([np.cos(angle / DEGREES_A_RADIAN), np.sin(angle / DEGREES_A_RADIAN), 0.0])
        at = tilt @ ((radius + 0.035) * out + [0, 0, 1e-3 * leg]) + [0.002, -0.001, 0.003]
        machine = put(
            machine,
            leg,
            base__center=at,
            base__axis=tilt @ [0, 0, 1],
            platform__center=tilt @ (0.035 * out),
            length__constant=rod,
        )
    return machine


def ideal_rotary(radius=0.052, angles=(90.4, 209.5, 330.8)):
    """Arms in vertical planes through one axis, each of its own length and height."""
    machine = load_mechanism("delta")
    for leg, angle in enumerate(angles, start=1):
        out = np.array([np.cos(angle / DEGREES_A_RADIAN), np.sin(angle / DEGREES_A_RADIAN), 0.0])
        machine = put(
            machine,
            leg,
            base__center=(radius + 0.035) * out + [0.001, 0.0005, 1e-3 * leg],
            base__axis=np.cross([0.0, 0.0, 1.0], out),
            base__arm=0.1 + 5e-4 * leg,
            base__angle=0.01 * leg,
            platform__center=0.035 * out,
            length__constant=0.22 + 3e-4 * leg,
        )
    return machine


def test_an_ideal_linear_delta_is_recovered():
    machine = ideal_linear()
    fit = nearest_fit(delta_of(machine, "x"), klipper.Klipper.linear)
    assert fit.largest < 1e-4
    assert fit.radius == pytest.approx(110, abs=1e-3)
    # turned by the base frame's tilt about z, to first order
    np.testing.assert_allclose(
        fit.angle, np.array([211, 328.5, 90.7]) + 0.002 * DEGREES_A_RADIAN, atol=2e-3
    )
    np.testing.assert_allclose(fit.rod, [270, 271.2, 269.5], atol=1e-3)
    text = make_export(source_of(machine), "klipper").files["pkmcal_printer.cfg"]
    config = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
    config.read_string(text)
    assert config.getfloat("stepper_b", "arm_length") == pytest.approx(271.2, abs=1e-3)
    assert config.getfloat("printer", "delta_radius") == pytest.approx(110, abs=1e-3)


@pytest.mark.parametrize("firmware", firmwares(), ids=lambda one: one.name)
def test_a_firmware_reads_what_it_writes(firmware):
    entries = {"workspace_radius": 0.0905, "height_offset": 0.0, "steps_per_mm": 3 * (800.0,)}
    rods = [0.2695, 0.27, 0.2712] if firmware.linear.rods else 3 * [0.27]
    machine = with_values(ideal_linear(rods=rods), **entries)
    (text,) = firmware.files(source_of(machine)).values()
    assert [one for one in firmwares() if one.evidence(text, "x")] == [firmware]
    printer = firmware_of(text, "x").printer(text, Path("x"))
    assert printer.radius == pytest.approx(110, abs=1e-3)
    assert printer.reach == (None if firmware.name in ("marlin", "smoothie") else 90.5)
    np.testing.assert_allclose(np.sort(printer.rod), 1e3 * np.array(rods), atol=1e-3)
    # carriages at the bed's centre, from the rods' lengths and the towers' circle
    heights = printer.carriages(np.zeros((1, 3)))[0]
    np.testing.assert_allclose(heights, np.sqrt(printer.rod**2 - 110**2), atol=2e-3)
    # each tower stands 1 mm higher than the last
    assert np.ptp(printer.homed) == pytest.approx(2, abs=5e-3)


def test_an_ideal_rotary_delta_is_recovered():
    machine = ideal_rotary()
    fit = nearest_fit(delta_of(machine, "x"), Freedoms(reprap.REPRAP_TOWER_ANGLES))
    assert fit.largest < 1e-4
    assert fit.order.tolist() == [1, 2, 0]
    assert fit.radius == pytest.approx(52, abs=1e-3)
    np.testing.assert_allclose(fit.angle, [-150.5, -29.2, 90.4], atol=1e-3)
    np.testing.assert_allclose(fit.arm, [101, 101.5, 100.5], atol=1e-3)
    np.testing.assert_allclose(fit.rod, [220.6, 220.9, 220.3], atol=1e-3)
    # Klipper has one height for all, so that it cannot follow
    made = make_export(source_of(machine), "klipper")
    assert made.notes[0].level is Level.DOUBTFUL
    assert "tilted arms" in made.notes[0].text


KINDS = [(to, name) for to in FIRMWARES for name in ("delta", "linear-delta")]
KINDS.remove(("marlin", "delta"))


@pytest.mark.parametrize(("to", "name"), KINDS)
def test_a_machine_off_its_nominal_model_is_followed_as_far_as_stated(name, to):
    machine = built(name, seed=4)
    made = make_export(source_of(machine), to)
    difference = made.differences[0]
    assert "off by" in made.notes[0].text
    assert not difference.beyond
    # the stated error is the actual one, not a multiple of it
    assert difference.largest > 0.9 * (difference.limit - 2e-6) / 1.02
    drawn = make_export(source_of(load_mechanism(name)), to)
    assert drawn.differences[0].largest < 5e-5
    assert drawn.notes[0].level is Level.NOTE


@pytest.mark.parametrize("name", ["delta", "linear-delta"])
def test_linuxcnc_gets_a_module_of_what_its_own_do_not_follow(name):
    drawn = make_export(source_of(load_mechanism(name)), "linuxcnc")
    assert set(drawn.files) == {"pkmcal_kinematics.hal", "pkmcal_kinematics.ini"}
    assert 0 < drawn.differences[0].largest < 5e-5
    made = make_export(source_of(built(name, seed=4)), "linuxcnc")
    assert set(made.files) == {
        *("pkmcal_kinematics.ini", "pkmcal_kins.c"),
        *("pkmcal_kinematics.c", "pkmcal_kinematics.h"),
    }
    assert "KINEMATICS = pkmcal_kins\n" in made.files["pkmcal_kinematics.ini"]
    assert made.differences[0].largest < 1e-12
    assert all(note.level is Level.NOTE for note in made.notes)


# Limits and switches that a printer has of its own


def with_values(machine, **values):
    """The machine with entries of its mechanism file that exports keep."""
    return replace(machine, document=machine.document.model_copy(update=values))


def with_radius(machine, radius):
    """The machine whose printer keeps to a radius, m."""
    return with_values(machine, workspace_radius=radius)


def klipper_config(text):
    config = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
    config.read_string(text)
    return config


def test_the_print_radius_is_the_printers_own(tmp_path):
    """The reachable radius, 162 mm for this machine, is in no file."""
    machine = load_mechanism("linear-delta")
    g = exporters()["reprap"].files(source_of(machine))["pkmcal_delta.g"]
    assert "665B" not in reprap.read_words(g)
    text = exporters()["klipper"].files(source_of(machine))["pkmcal_printer.cfg"]
    assert "print_radius" not in klipper_config(text)["printer"]
    own = source_of(with_radius(load_mechanism("delta"), 0.0905))
    words = reprap.read_words(exporters()["reprap"].files(own)["pkmcal_delta.g"])
    assert words["669B"].tolist() == [90.5]
    # through a calibration's folder as well
    source = load_source(calibration(tmp_path, with_radius(built("linear-delta"), 0.0905)))
    text = exporters()["klipper"].files(source)["pkmcal_printer.cfg"]
    assert klipper_config(text).getfloat("printer", "print_radius") == 90.5
    made = make_export(source, "reprap")
    assert reprap.read_words(made.files["pkmcal_delta.g"])["665B"].tolist() == [90.5]
    assert made.notes[-1].facts["radius"] == "90.5"


@pytest.mark.parametrize(
    ("to", "name"),
    [
        *((one.name, "linear-delta") for one in firmwares()),
        ("klipper", "delta"),
        ("reprap", "delta"),
    ],
)
def test_only_a_firmware_with_a_print_radius_keeps_one(name, to, tmp_path):
    has = to != "smoothie" and (to, name) != ("klipper", "delta")
    for radius, folder in ((0.0905, "stated"), (None, "unstated")):
        machine = with_radius(built(name), radius) if radius else built(name)
        (tmp_path / folder).mkdir()
        source = load_source(calibration(tmp_path / folder, machine))
        if to == "repetier":
            document = machine.document.model_copy(update={"steps_per_mm": (80.0, 80.0, 80.0)})
            source = replace(source, machine=replace(source.machine, document=document))
        (redo,) = (one for one in make_export(source, to).notes if one.code == "export.redo")
        assert redo.facts["radius"] == ("90.5" if has and radius else None)
        assert redo.facts["limit"] == ("print radius" if has and not radius else None)


def switch_lines(text):
    """Each motor's line of values for end switches elsewhere."""
    return [line for line in text.splitlines() if "reading - " in line or " rad, " in line]


@pytest.mark.parametrize(("to", "name"), KINDS)
def test_an_end_switch_elsewhere_has_a_number_of_its_own(to, name):
    """The tool's place by the firmware, homed by that number, is the machine's."""
    machine = built(name, seed=4)
    text = next(iter(make_export(source_of(machine), to).files.values()))
    lines = switch_lines(text)
    assert len(lines) == 3
    linear = name == "linear-delta"
    motors = re.findall(
        r"Motor (\w) is leg \d, joint (\d): .* = (\S+) \* reading \(\w+\) (\S+)\.\n", text
    )
    for k, (line, (_, joint, rate, zero)) in enumerate(zip(lines, motors, strict=True)):
        low, high = machine.joint_ranges[int(joint) - 1]
        end = high if float(rate) > 0 else low
        reading = end + 0.2 * (low + high - 2 * end)
        motor = float(rate) * reading + float(zero)
        if to == "klipper" and not linear:
            # an elbow a lower arm away from the tool in the middle, at every pair of the table
            config = klipper_config(text)
            section = config["stepper_" + "abc"[k]]
            arm, rod = (section.getfloat(f"{side}_arm_length") for side in ("upper", "lower"))
            pairs = re.findall(r"(\S+) at (\S+) rad", line)
            assert len(pairs) > 8
            for height, at in pairs:
                angle = (float(rate) * float(at) + float(zero)) / DEGREES_A_RADIAN
                out = config.getfloat("printer", "shoulder_radius") + arm * np.cos(angle)
                up = config.getfloat("printer", "shoulder_height") + arm * np.sin(angle)
                assert np.hypot(out, up - float(height)) == pytest.approx(rod, abs=2e-3)
            continue
        value, sign, slope, place = re.search(
            r"= (\S+) ([+-]) (\S+) \* \(reading - (\S+)\)", line
        ).groups()
        number = float(float(value) + float(sign + slope) * (reading - float(place)))
        if to == "klipper":
            config = klipper_config(text)
            config["stepper_" + "abc"[k]]["position_endstop"] = repr(number)
            homed = klipper.homed(config)
        elif to == "marlin":
            rod, tower = (
                [float(v) for v in re.findall(rf"^M665 .*{c}(-?[\d.]+)", text, re.MULTILINE)]
                for c in ("ABC"[k], "R")
            )
            length = float(re.search(r"^M665 L([\d.]+)", text, re.MULTILINE)[1]) + rod[0]
            # the carriage, with the nozzle in the middle at this switch's height
            homed = np.full(3, number + np.sqrt(length**2 - tower[0] ** 2))
        else:
            words = reprap.read_words(text)
            words["666" + "XYZ"[k]] = np.array([number])
            homed = reprap.homed_carriages(words) if linear else reprap.homed_arms(words)
        assert homed[k] == pytest.approx(motor, abs=2e-3)


def test_parallel_towers_are_followed_where_leaning_ones_are_not():
    leaning = put(ideal_linear(), 1, base__axis=[0.004, 0.0, 1.0])
    for to in FIRMWARES:
        assert make_export(source_of(ideal_linear()), to).differences[0].largest < 1e-6
        made = make_export(source_of(leaning), to)
        assert made.notes[0].level is Level.DOUBTFUL
        assert "towers that are not parallel" in made.notes[0].text
        assert 5e-5 < made.differences[0].largest < 5e-3


@pytest.mark.parametrize(
    ("to", "file", "old", "new"),
    [
        ("reprap", "pkmcal_delta.g", "R104.9", "R104.8"),
        ("reprap", "pkmcal_delta.g", "M666 X0.0000", "M666 X0.0100"),
        ("reprap", "pkmcal_delta.g", "A0 B0", "A0.1 B0"),
        ("klipper", "pkmcal_printer.cfg", "angle: 210.0", "angle: 210.1"),
        ("klipper", "pkmcal_printer.cfg", "endstop: 301.2", "endstop: 301.3"),
        ("linuxcnc", "pkmcal_kinematics.hal", "lineardeltakins.R 10", "lineardeltakins.R 11"),
        ("linuxcnc", "pkmcal_kinematics.ini", "HOME_OFFSET = -0.0", "HOME_OFFSET = 1.0"),
        ("linuxcnc", "pkmcal_kinematics.ini", "HOME = 398.7", "HOME = 0"),
        ("linuxcnc", "pkmcal_kinematics.ini", "MAX_LIMIT = 549.", "MAX_LIMIT = 559."),
        ("reprap", "pkmcal_delta.g", " ; L rods", " B162 ; L rods"),
        ("reprap", "pkmcal_delta.g", "M666 Y = 0 + 1000", "M666 Y = 0 - 1000"),
        ("klipper", "pkmcal_printer.cfg", "delta_radius: ", "print_radius: 99\ndelta_radius: "),
        ("marlin", "pkmcal_marlin.gcode", "R104.9", "R104.8"),
        ("marlin", "pkmcal_marlin.gcode", "M666 X0.0000", "M666 X-0.5000"),
        ("marlin", "pkmcal_marlin.gcode", "M666 X0.0000", "M666 X0.0003"),
        ("marlin", "pkmcal_marlin.gcode", "M666 X0.0000", "M666 X-0.0003"),
        ("marlin", "pkmcal_marlin.gcode", "A0.0000", "A0.1000"),
        ("marlin", "pkmcal_marlin.gcode", "Z of Y's switch = 3", "Z of Y's switch = 4"),
        ("marlin", "pkmcal_marlin.gcode", "M666 X", "M92 X80 Y80 Z80\nM666 X"),
        ("marlin", "pkmcal_marlin.gcode", "; #define DELTA_RADIUS ",
         "; #define DELTA_PRINTABLE_RADIUS 99\n; #define DELTA_RADIUS "),
        ("smoothie", "pkmcal_smoothie.gcode", "M206 X0", "M92 X80 Y80 Z80\nM206 X0"),
        ("reprap", "pkmcal_delta.g", "M669 K3", "M92 X80 Y80 Z80\nM669 K3"),
    ],
)  # fmt: skip
def test_tampered_settings_are_found(to, file, old, new):
    source = source_of(load_mechanism("linear-delta"))
    files = exporters()[to].files(source)
    spoilt = {**files, file: files[file].replace(old, new, 1)}
    assert spoilt != files
    assert any(d.beyond for d in exporters()[to].check(spoilt, source))


# The firmwares' formulas, at places where the answer is known


def test_reprap_carriages_at_home():
    text = "M665 L250:251:252 R100 H300 B90 X0 Y0 Z0\nM666 X1 Y-1 Z0.5 A0 B0"
    words = reprap.read_words(text)
    homed = 300 + np.sqrt(np.array([250, 251, 252]) ** 2 - 100.0**2) + [1, -1, 0.5]
    np.testing.assert_allclose(reprap.homed_carriages(words), homed)
    middle = reprap.reprap_carriage_heights(words, np.array([[0.0, 0.0, 300.0]]))[0]
    np.testing.assert_allclose(middle, homed - [1, -1, 0.5])
    # towards the X tower, at the front left, its carriage rises
    remainder = reprap.reprap_carriage_heights(words, np.array([[-10.0, -10 / np.sqrt(3), 300.0]]))[
        0
    ]
    assert remainder[0] > middle[0]
    assert remainder[1] < middle[1]


def test_arms_of_all_programs_in_the_middle():
    """Arm 100, rod 200, radius 40: horizontal arms hold the tool sqrt(200^2 - 140^2) below."""
    below = np.sqrt(200.0**2 - 140.0**2)
    text = "M669 K10 U100:100:100 L200:200:200 H300:300:300 R40 A-60:30 B80 X0 Y0 Z0"
    words = reprap.read_words(text)
    point = np.array([[0.0, 0.0, 300 - below], [0.0, 0.0, 320 - below]])
    values = reprap.reprap_arm_angles(words, point)
    np.testing.assert_allclose(values[0], 0, atol=1e-12)
    assert (values[1] > 1).all()  # upwards counts up
    config = ConfigParser(delimiters=(":",))
    stepper = "upper_arm_length: 100\nlower_arm_length: 200\nposition_endstop: 1\n"
    config.read_string(
        "[printer]\nkinematics: rotary_delta\nshoulder_radius: 40\nshoulder_height: 300\n"
        + "".join(
            f"[stepper_{n}]\n{stepper}angle: {a}\n"
            for n, a in zip("abc", (210, 330, 90), strict=True)
        )
    )
    np.testing.assert_allclose(klipper.klipper_arm_angles(config, point), values, atol=1e-9)
    side = np.array([[20.0, -10.0, 150.0]])
    np.testing.assert_allclose(
        klipper.klipper_arm_angles(config, side), reprap.reprap_arm_angles(words, side), atol=1e-9
    )
    pins = {"platformradius": 50.0, "footradius": 10.0, "thighlength": 100.0, "shinlength": 200.0}
    mid = rotary_joints(pins, point - [0, 0, 300])
    np.testing.assert_allclose(mid, -values, atol=1e-9)
    # joint 0 at -90 degrees, 1 at 30: the arm that the tool goes to goes up, its angle falls
    for k, angle in enumerate((-90, 30, 150)):
        p = np.array(
            [[20 * np.cos(angle / DEGREES_A_RADIAN), 20 * np.sin(angle / DEGREES_A_RADIAN), -150.0]]
        )
        assert np.argmin(rotary_joints(pins, p)[0]) == k


def test_lineardeltakins_joint_0_is_the_tower_behind():
    joints = linear_joints({"R": 100.0, "L": 250.0}, np.array([[0.0, 30.0, 10.0]]))[0]
    assert joints[0] == pytest.approx(10 + np.sqrt(250**2 - 70**2))
    assert joints[1] == pytest.approx(joints[2])


def test_genhexkins_angles_are_roll_pitch_yaw():
    machine = built("gough-stewart")
    poses = samples(machine, 8)[0]
    value = linuxcnc.world(poses)
    for T, (a, b, c) in zip(poses, value[:, 3:] / DEGREES_A_RADIAN, strict=True):
        rot = rotation(np.array([0, 0, c])) @ rotation(np.array([0, b, 0]))
        np.testing.assert_allclose(rot @ rotation(np.array([a, 0, 0])), T[:3, :3], atol=1e-12)
    made = make_export(source_of(machine), "linuxcnc")
    assert "setp genhexkins.max-error 29" in made.files["pkmcal_kinematics.hal"]
    offset = machine.values[machine.parameters.index("legs[2].length.offset")]
    ini = made.files["pkmcal_kinematics.ini"]
    scale = machine.values[machine.parameters.index("legs[2].scale")]
    offset, rate = float(1e3 * offset), float(1e3 * scale)
    word = f"TYPE = LINEAR\n# joint 1 = {rate!r} * reading + {offset!r}\n"
    word += "# Divide its SCALE in the INI file, steps or counts per unit, by"
    word += f" {float(scale)!r}.\nHOME_ABSOLUTE_ENCODER = 2\n"
    home = float(machine.inverse(machine.home()[None])[0, 1] * rate + offset)
    assert f"[JOINT_1]\n{word}HOME_OFFSET = {offset!r}\nHOME = {home!r}\n" in ini
    assert ini.count("HOME_SEQUENCE = 0\n") == 6


def test_a_home_beyond_the_limits_is_no_home(tmp_path):
    text = catalogue()["linear-delta"].read_text()
    (tmp_path / "m.yaml").write_text(text.replace("range: [0.25, 0.55]", "range: [0.25, 0.35]"))
    with pytest.raises(InputError) as caught:
        make_export(source_of(load_mechanism(tmp_path / "m.yaml")), "linuxcnc")
    assert caught.value.code == "export.home_outside_range"


# Machines that are no firmware's


def test_ranges_are_needed(tmp_path):
    text = catalogue()["linear-delta"].read_text().replace(", range: [0.25, 0.55]", "")
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        make_export(source_of(load_mechanism(tmp_path / "m.yaml")), "klipper")
    assert caught.value.code == "export.no_range"


def test_towers_lean_too_much():
    machine = put(load_mechanism("linear-delta"), 1, base__axis=[0.7, 0.0, 0.7])
    with pytest.raises(InputError) as caught:
        delta_of(machine, "Klipper")
    assert caught.value.found == "towers that lean"


def test_arms_swing_sideways():
    machine = put(load_mechanism("delta"), 1, base__axis=[0.0, 1.0, 0.1])
    with pytest.raises(InputError) as caught:
        delta_of(machine, "Klipper")
    assert caught.value.found == "arms that do not swing outwards"


def test_a_machine_that_no_settings_follow_is_refused():
    machine = put(load_mechanism("linear-delta"), 1, base__axis=[0.1, 0.1, 1.0])
    with pytest.raises(InputError) as caught:
        make_export(source_of(machine), "reprap")
    assert caught.value.code == "export.not_followed"


def test_four_towers_are_no_delta(tmp_path):
    text = catalogue()["linear-delta"].read_text()
    fourth = text[text.index("  - base") : text.index("  - base", text.index("  - base") + 1)]
    fourth = fourth.replace("-0.1212, -0.07", "0.14, 0.1")
    (tmp_path / "m.yaml").write_text(text.replace("home:", fourth + "home:"))
    with pytest.raises(InputError) as caught:
        delta_of(load_mechanism(tmp_path / "m.yaml"), "Klipper")
    assert caught.value.found == "4 equations for 3 unknowns"


def test_arms_beyond_the_arc_sine(tmp_path):
    text = catalogue()["delta"].read_text().replace("range: [-0.6, 1.3]", "range: [-0.6, 1.6]")
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        make_export(source_of(load_mechanism(tmp_path / "m.yaml")), "reprap")
    lowest, _ = map(float, re.findall(r"-?\d+\.\d", caught.value.found))
    assert lowest < -90


def test_klipper_end_switch_without_a_height(tmp_path):
    text = catalogue()["delta"].read_text().replace("constant: 0.22", "constant: 0.13")
    (tmp_path / "m.yaml").write_text(text.replace("-0.22]", "-0.1]"))
    with pytest.raises(InputError) as caught:
        make_export(source_of(load_mechanism(tmp_path / "m.yaml")), "klipper")
    reach, rod = map(float, re.findall(r"\d+\.\d", caught.value.found))
    assert reach > rod


def test_nothing_closes_within_the_ranges():
    machine = load_mechanism("linear-delta")
    for leg in (1, 2, 3):
        machine = put(machine, leg, length__constant=0.01)
    with pytest.raises(InputError) as caught:
        delta_of(machine, "Klipper")
    assert caught.value.code == "export.no_workspace"
