"""Delta printers in every firmware's dialect, by an independent forward kinematics; Smoothieware's
and Repetier-Firmware's files.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import replace

import numpy as np
import pytest

import printers
from dialects import (
    DIALECTS,
    HEIGHT_OFFSET,
    STEPS,
    Ideal,
    carried,
    commands,
    letters,
    perturbed,
)
from export_sources import source_of
from faults import raises
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.exporters.delta import delta_of
from pkmcal.exporters.delta_texts import read_firmware_from_base
from pkmcal.firmware.contract import firmwares, read_printer
from pkmcal.firmware.probed import read_measured
from pkmcal.firmware.session import nominal_text, printer_session_texts
from pkmcal.geometry.rigid import apply
from pkmcal.mechanisms import load_mechanism
from test_marlin import CONFIGURATION

SMOOTHIE = """\
Recv: ;Steps per unit:
Recv: M92 X80.00000 Y80.00000 Z100.00000
Recv: ;Optional arm solution specific settings:
Recv: M665 A0.0000 B0.0000 C0.0000 D0.2000 E-0.1000 H0.3000 I0.1000 J-0.2000 K0.4000 L270.0000\
 R105.0000
Recv: ;Home offset (mm):
Recv: M206 X0.00 Y0.00 Z0.50
Recv: ;Trim (mm):
Recv: M666 X-0.250 Y0.000 Z-1.500
Recv: ;Max Z
Recv: M665 Z299.500
"""
CONFIG = """\
# Robot module
arm_solution         linear_delta   # a comment
arm_length           270.0  # mm
#arm_length          99.0
arm_radius           105.0
arm1_trim 0.1
arm2_trim -0.2
arm3_trim 0.4
delta_tower1_angle 0.2
delta_tower2_angle -0.1
delta_tower3_angle 0.3
alpha_steps_per_mm   80
beta_steps_per_mm    80
gamma_steps_per_mm   100
alpha_trim_mm -0.25
gamma_trim_mm -1.5
gamma_max            300
"""
REPETIER = """\
20:41:33.748 : EPR:3 11 80.0000 Steps per mm
20:41:33.771 : EPR:3 153 300.000 Z max length [mm]
20:41:33.785 : EPR:3 881 270.000 Diagonal rod length [mm]
20:41:33.787 : EPR:3 885 105.000 Horizontal rod radius at 0,0 [mm]
20:41:33.790 : EPR:3 925 90.000 Max printable radius [mm]
20:41:33.793 : EPR:1 893 20 Tower X endstop offset [steps]
20:41:33.795 : EPR:1 895 0 Tower Y endstop offset [steps]
20:41:33.797 : EPR:1 897 120 Tower Z endstop offset [steps]
20:41:33.801 : EPR:3 901 210.200 Alpha A(210):
20:41:33.805 : EPR:3 905 329.900 Alpha B(330):
20:41:33.808 : EPR:3 909 90.300 Alpha C(90):
20:41:33.810 : EPR:3 913 0.000 Delta Radius A(0):
20:41:33.819 : EPR:3 933 0.100 Corr. diagonal A [mm]
20:41:33.822 : EPR:3 937 -0.200 Corr. diagonal B [mm]
20:41:33.825 : EPR:3 941 0.400 Corr. diagonal C [mm]
"""
REPETIER_HOST = "".join(
    re.sub(r".*EPR:(\d) (\d+) (\S+) (.*)", r'<epr pos="\2" type="\1" value="\3">\4</epr>', line)
    for line in REPETIER.splitlines()
)
"""In one line, as Repetier-Host writes it."""
REPETIER_HEADER = """\
#define DRIVE_SYSTEM 3
#define STEPS_PER_ROTATION 200 // 1.8 degrees
#define MICRO_STEPS 16
#define AXIS_STEPS_PER_MM ((float)(MICRO_STEPS * STEPS_PER_ROTATION) / 40.0)
#define ZAXIS_STEPS_PER_MM AXIS_STEPS_PER_MM
#define Z_MAX_LENGTH 300
#if DRIVE_SYSTEM == DELTA
#define DELTA_DIAGONAL_ROD 270 // mm
#define DELTA_ALPHA_A 210.2
#define DELTA_ALPHA_B 329.9
#define DELTA_ALPHA_C 90.3
#define DELTA_DIAGONAL_CORRECTION_A 0.1
#define DELTA_DIAGONAL_CORRECTION_B -0.2
#define DELTA_DIAGONAL_CORRECTION_C 0.4
#define DELTA_MAX_RADIUS 90
#define PRINTER_RADIUS 160
#define ROD_RADIUS (PRINTER_RADIUS-30-25)
#define DELTA_X_ENDSTOP_OFFSET_STEPS 20
#define DELTA_Y_ENDSTOP_OFFSET_STEPS 0
#define DELTA_Z_ENDSTOP_OFFSET_STEPS 120
#elif DRIVE_SYSTEM == TUGA
#define DELTA_DIAGONAL_ROD 240
#endif
"""


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


def text_file(folder, text, name="printer.txt"):
    path = folder / name
    path.write_text(text)
    return path


def test_every_firmware_has_its_dialect():
    assert [one.name for one in firmwares()] == sorted(DIALECTS)


def test_the_forward_kinematics_in_known_places():
    """In the middle all carriages are a rod's rise above the tool."""
    delta = Ideal(105.0, np.array([210.0, 330.0, 90.0]), np.full(3, 270.0), np.zeros(3))
    rise = np.sqrt(270.0**2 - 105.0**2)
    np.testing.assert_allclose(delta.tool([[rise + 50] * 3]), [[0, 0, 50]], atol=1e-9)
    # the tool goes away from the tower, at the front left, whose carriage is lowered
    x, y, _ = delta.tool([[rise + 40, rise + 50, rise + 50]])[0]
    assert x > 1
    assert y > 1


@pytest.mark.parametrize("to", DIALECTS)
@pytest.mark.parametrize("seed", range(20))
def test_a_firmware_goes_where_the_machine_goes(seed, to):
    machine, rng = perturbed(seed, to=to)
    (text,) = make_export(source_of(machine), to).files.values()
    ideal = DIALECTS[to](text, HEIGHT_OFFSET)
    travel = carried(machine, rng)
    there = 1e3 * machine.forward(machine.joint_ranges[:, 1] + travel)[:, :3, 3]
    there = 1e3 * apply(read_firmware_from_base(text), 1e-3 * there)
    # Repetier's end switches are in whole steps
    limit = 1e-3 if to != "repetier" else 3 * 0.5 / STEPS
    np.testing.assert_allclose(ideal.tool(ideal.homed + 1e3 * travel), there, atol=limit)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (SMOOTHIE, "smoothie"),
        (CONFIG, "smoothie"),
        (REPETIER, "repetier"),
        (
            f"<?xml?><Repetier-Firmware-EEPROM>{REPETIER_HOST}</Repetier-Firmware-EEPROM>",
            "repetier",
        ),
        (REPETIER_HEADER, "repetier"),
    ],
)
def test_a_printer_is_read_and_written_back(text, name, tmp_path):
    printer = read_printer(text_file(tmp_path, text))
    assert printer.firmware.name == name
    assert printer.radius == 105.0
    np.testing.assert_allclose(printer.angle, [210.2, 329.9, 90.3])
    np.testing.assert_allclose(printer.rod, [270.1, 269.8, 270.4])
    # a carriage retracts from a switch that triggers higher
    want = 300 + np.sqrt(printer.rod**2 - 105**2) + [0.25, 0.0, 1.5]
    np.testing.assert_allclose(printer.homed, want)
    assert printer.reach == (90.0 if name == "repetier" else None)
    if name == "smoothie":  # rods of one length, as it has without builds of a pull request
        printer = replace(printer, rod=np.full(3, 270.0))
        want = printer.homed
    machine = load_mechanism(text_file(tmp_path, nominal_text(printer), "m.yaml"))
    (out,) = make_export(source_of(machine), name).files.values()
    ideal = DIALECTS[name](out, 0.0)
    np.testing.assert_allclose(ideal.homed, want, atol=1e-3)
    np.testing.assert_allclose(ideal.rod, printer.rod, atol=1e-3)
    again = read_printer(text_file(tmp_path, out, "again.txt"))
    assert again.firmware.name == name
    np.testing.assert_allclose(again.homed, want, atol=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        changed(SMOOTHIE, "A0.0000 B0.0000", "A-0.4200 B0.9800"),
        changed(REPETIER, "913 0.000 Delta Radius A(0):", "913 -0.420 x\nEPR:3 917 0.980 x"),
    ],
)
def test_towers_with_radii_of_their_own_are_on_one_circle_elsewhere(text, tmp_path):
    """The session's machine goes as the firmware commands, but for the middle of its frame."""
    printer = read_printer(text_file(tmp_path, text))
    radius = 105.0 + np.array([-0.42, 0.98, 0.0])
    np.testing.assert_allclose(
        printer.homed, 300 + np.sqrt(printer.rod**2 - radius**2) + [0.25, 0, 1.5], atol=1e-9
    )
    points = np.array([[0.0, 0.0, 0.0], [60.0, 20.0, 0.0], [-30.0, 50.0, 40.0], [0, -70.0, 90.0]])
    a = np.deg2rad([210.2, 329.9, 90.3])
    towers = radius[:, None] * np.column_stack([np.cos(a), np.sin(a)])
    away = np.linalg.norm(points[:, None, :2] - towers, axis=-1)
    carriages = points[:, 2:] + np.sqrt(printer.rod**2 - away**2)
    np.testing.assert_allclose(printer.carriages(points), carriages, atol=1e-9)
    machine = load_mechanism(text_file(tmp_path, nominal_text(printer), "m.yaml"))
    there = 1e3 * machine.forward(1e-3 * carriages)[:, :3, 3]
    shift = there - points
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:1], shift.shape), atol=1e-3)
    assert abs(shift[0, 2]) < 1e-3
    assert 0.3 < np.linalg.norm(shift[0, :2]) < 1


@pytest.mark.parametrize("seed", range(3))
def test_rods_of_different_lengths_are_one_for_smoothieware(seed):
    """It has one length: the best one is written, and the error that remains is stated."""
    machine, _ = perturbed(seed)
    export = make_export(source_of(machine), "smoothie")
    (text,) = export.files.values()
    written = commands(text)
    assert not letters(written, "665", "IJK").any()
    (follows,) = (note for note in export.notes if note.code.startswith("export.follows"))
    delta = delta_of(machine, "Smoothieware")
    there = 1e3 * apply(read_firmware_from_base(text), delta.positions)
    ideal = DIALECTS["smoothie"](text, 0.0)
    travel = 1e3 * (delta.readings - delta.ends)
    off = np.linalg.norm(ideal.tool(ideal.homed + travel) - there, axis=1).max()
    assert 0.1 < off <= 1.05 * follows.facts["largest"]


@pytest.mark.parametrize("to", ["marlin", "reprap", "smoothie"])
def test_steps_are_corrected_by_a_scale(to):
    machine, _ = perturbed(2, scale=(1.001, 1.0, 0.999))
    (text,) = make_export(source_of(machine), to).files.values()
    written = commands(text)
    np.testing.assert_allclose(
        [written["92" + c] for c in "XYZ"], STEPS / np.array([1.001, 1.0, 0.999]), atol=1e-4
    )


def test_repetier_needs_motor_steps():
    with pytest.raises(InputError) as caught:
        make_export(source_of(printers.machine(printers.Settings())), "repetier")
    assert caught.value.found == "no steps_per_mm"


WRONG = {
    changed(SMOOTHIE, "M665 Z299.500", ""): {
        "where": "printer.txt",
        "expected": "the lines M665 that M503 prints, with L, R and Z, or arm_length, "
        "arm_radius and gamma_max",
    },
    changed(SMOOTHIE, "R105.0000", "Rnan"): {
        "where": "printer.txt, line 4",
        "found": "'M665 A0.0000 B0.0000 C0.0000 D0.2000 E-0.1000 H0.3000 I0.1…",
    },
    changed(SMOOTHIE, "M206 X0.00", "M206 X1.00"): {
        "where": "printer.txt, line 6",
        "found": "1",
        "expected": "0",
    },
    changed(CONFIG, "arm_radius           105.0", "arm_radius inf"): {
        "where": "printer.txt, line 5",
        "found": "'inf'",
        "expected": "a number in mm, or degrees",
    },
    changed(REPETIER_HOST, '"105.000"', '"105,0"'): {
        "where": "printer.txt, line 1",
        "found": '\'<epr pos="885" type="3" value="105,0">\'',
    },
    changed(REPETIER, "913 0.000", "913 0.100")
    .replace("210.200", "329.900")
    .replace("933 0.100", "917 0.100 x\nEPR:3 933 0.100"): {
        "where": "printer.txt",
        "found": "329.9, 329.9, 90.3 degrees",
    },
    changed(REPETIER, "EPR:3 153", "EPR:3 154"): {
        "where": "printer.txt",
        "expected": "a line EPR: with 153 and a number, as M205 prints it",
    },
    changed(REPETIER, "EPR:3 885 105.000", "EPR:3 885 1e9"): {
        "where": "printer.txt, line 4",
        "found": "'EPR:3 885 1e9 Horizontal rod radius at 0,0 [mm]'",
        "expected": "a number in mm, degrees or steps",
    },
    changed(REPETIER, "EPR:3 11 80.0000", "EPR:3 11 0"): {
        "where": "printer.txt, line 1",
        "found": "0",
        "expected": "above 0",
    },
    changed(REPETIER_HEADER, "SYSTEM 3", "SYSTEM 1"): {
        "where": "printer.txt, line 1",
        "found": "'DRIVE_SYSTEM 1'",
    },
    changed(REPETIER_HEADER, "#define ROD_RADIUS (P", "#define END_EFFECTOR_OFFSET (P"): {
        "where": "printer.txt",
        "expected": "#define END_EFFECTOR_HORIZONTAL_OFFSET with a number",
    },
    changed(REPETIER_HEADER, "PRINTER_RADIUS", "P").replace("ROD_RADIUS (", "ROD_RADUIS ("): {
        "where": "printer.txt",
        "found": "'ROD_RADUIS' in line 17",
    },
    f"EPR:3 {5000 * '8'} 1 x\n": {
        "where": "printer.txt",
        "found": "'EPR:3 8888888888888888888888888888888888888888888888888888…",
    },
}


@pytest.mark.parametrize("text", WRONG, ids=[facts["where"] for facts in WRONG.values()])
def test_what_these_firmwares_have_not_is_refused(text, tmp_path):
    with raises(InputError, **WRONG[text]):
        read_printer(text_file(tmp_path, text))


@pytest.mark.parametrize("beside", [True, False])
def test_values_that_config_g_loads_count_where_their_file_is_beside_it(tmp_path, beside):
    """RepRapFirmware's M501 loads config-override.g in place; a later M665 counts more."""
    own, saved = "M665 R100 L250 H300\nM666 X1 Y0 Z0\n", "M665 R104 L252 H301\n"
    (tmp_path / "config.g").write_text(f"{own}M501\n")
    if beside:
        (tmp_path / "config-override.g").write_text(saved)
    printer = read_printer(tmp_path / "config.g")
    assert (printer.radius, printer.rod.tolist()) == (
        (104, [252] * 3) if beside else (100, [250] * 3)
    )
    assert len(printer.remarks) == 1
    (tmp_path / "config.g").write_text(f"M501\n{own}")
    assert read_printer(tmp_path / "config.g").radius == 100


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("_trim_mm", "_trim"),  # until 2016
        (
            "gamma_max            300",
            "endstop.minz.axis Z\nendstop.minz.homing_direction none\n"
            "endstop.minz.homing_position 7\nendstop.maxz.axis Z\n"
            "endstop.maxz.homing_direction home_to_max\nendstop.maxz.homing_position 300",
        ),
        ("gamma_max            300", "gamma_max 299\ngamma_max 300"),
    ],
)
def test_older_and_newer_keys_of_smoothieware(old, new, tmp_path):
    printer = read_printer(text_file(tmp_path, changed(CONFIG, old, new)))
    np.testing.assert_allclose(printer.homed, read_printer(text_file(tmp_path, CONFIG)).homed)
    assert not printer.remarks


def test_the_third_tower_of_smoothieware_had_another_letter(tmp_path):
    old = read_printer(text_file(tmp_path, changed(SMOOTHIE, " H0.3000", " F0.3000")))
    np.testing.assert_allclose(old.angle, [210.2, 329.9, 90.3])


def test_points_of_smoothieware_are_counted_from_the_third_carriage(tmp_path):
    """G29.1 prints the carriage's height above the middle less the travel to contact."""
    printer = read_printer(text_file(tmp_path, CONFIG))
    a = np.deg2rad(60 * np.arange(6) + 30)
    want = np.column_stack([80 * np.cos(a), 80 * np.sin(a), 0.1 * np.arange(6)])
    want = np.vstack([want, [0, 0, -0.2]])
    text = "initial Bed ht is 295.000000 mm\ncenter probe: 0.0100\n"
    start, carriage = 5.0, 5.0 + np.sqrt(printer.rod[2] ** 2 - printer.radius**2)
    text += "".join(f"< X{x:.4f} Y{y:.4f} Z{carriage - (start - z):.4f}\n" for x, y, z in want)
    touches, _ = read_measured(text_file(tmp_path, text + "max delta: 0.7\n", "log.txt"), printer)
    ideal = Ideal(printer.radius, printer.angle, printer.rod, printer.homed)
    np.testing.assert_allclose(ideal.tool(touches.carriages), want, atol=1e-3)
    assert not touches.heights.any()
    # G29 without its .1 prints the probe's travel
    text = re.sub(r"X(\S+) Y(\S+) Z(\S+)", r"X:\1 Y:\2 Z:\3 A:1.0 B:1.0 C:1.0", text)
    with pytest.raises(InputError) as caught:
        read_measured(text_file(tmp_path, text, "log.txt"), printer)
    assert caught.value.code == "printer.probe_travel"
    assert "G29.1" in caught.value.next_step


@pytest.mark.parametrize("own", [False, True])
def test_repetiers_probing_has_no_heights(own, tmp_path):
    """A line is how far the probe moved, from a height that it does not contain."""
    probed = "".join(
        f"20:41:3{k}.1 : Z-probe:1{k}.123 X:{k}.00 Y:0.00 zCorr:0.000\n" for k in range(8)
    )
    path = text_file(tmp_path, REPETIER + probed if own else REPETIER)
    log = None if own else text_file(tmp_path, probed, "log.txt")
    with pytest.raises(InputError) as caught:
        printer_session_texts(path, log)
    assert caught.value.code == "printer.probe_travel"


@pytest.mark.parametrize(("off", "reported"), [(0.5, False), (16.0, True), (-4.0, True)])
def test_a_bed_far_from_z_0_is_a_remark(off, reported, tmp_path):
    """As of a probe's offset with the wrong sign: the height at home would change by as much."""
    (tmp_path / "printer.cfg").write_text(printers.printer_cfg(printers.Settings()))
    lines = [f"probe at {x:.3f},{y:.3f} is z={off:.4f}" for x, y in printers.bed(13)]
    (tmp_path / "probed.txt").write_text("\n".join(lines))
    _, remarks = printer_session_texts(tmp_path / "printer.cfg", tmp_path / "probed.txt")
    assert [f"Z {off:g} mm" in one for one in remarks] == ([True] if reported else [])


# ------------------------------------------------------------------ misspelt names

NAMED = {
    "klipper": (printers.printer_cfg(printers.Settings()), "printer.cfg"),
    "marlin": (CONFIGURATION, "Configuration.h"),
    "smoothie": (CONFIG, "config"),
}


def misspelt(name, key, wrong, folder):
    """File of a firmware with a key misspelt in all places; None for none."""
    text, file = NAMED[name]
    if key is not None:
        assert key in text
        text = text.replace(key, wrong)
    (folder / file).write_text(text)
    return folder / file


@pytest.mark.parametrize(
    ("name", "key", "wrong"),
    [
        ("klipper", "delta_radius", "delta_raduis"),
        ("klipper", "arm_length", "arm_lenght"),
        ("klipper", "[stepper_a]", "[steper_a]"),
        ("marlin", "DELTA_HEIGHT", "DELTA_HIGHT"),
        ("smoothie", "arm_radius", "arm_raduis"),
        ("smoothie", "arm_length", "arm_lenght"),
    ],
)
def test_a_misspelt_name_of_a_needed_value_is_in_the_error(name, key, wrong, tmp_path):
    with pytest.raises(InputError) as caught:
        read_printer(misspelt(name, key, wrong, tmp_path))
    assert wrong in caught.value.found
    assert key in caught.value.next_step


@pytest.mark.parametrize(
    ("name", "key", "wrong"),
    [
        ("klipper", "angle", "anlge"),
        ("klipper", "print_radius", "print_raduis"),
        ("marlin", "DELTA_ENDSTOP_ADJ", "DELTA_ENSTOP_ADJ"),
        ("smoothie", "gamma_trim_mm", "gama_trim_mm"),
    ],
)
def test_a_misspelt_name_of_a_value_with_a_default_is_a_remark(name, key, wrong, tmp_path):
    remarks = read_printer(misspelt(name, key, wrong, tmp_path)).remarks
    (*named,) = (one for one in remarks if wrong in one)
    assert len(named) == (3 if key == "angle" else 1)
    assert all(key in one for one in named)


@pytest.mark.parametrize("name", NAMED)
def test_names_without_a_mistake_give_no_remark(name, tmp_path):
    remarks = read_printer(misspelt(name, None, None, tmp_path)).remarks
    assert not any("is not read" in one for one in remarks)


@pytest.mark.parametrize(
    "line",
    ["M665 L{global.rod} R105 H300", "M665 L270 R105 H{300 + var.more}", "M92 X{80} Y80 Z80"],
)
def test_expressions_of_reprapfirmware_are_refused_with_what_to_write(line, tmp_path):
    text = "M665 L270 R105 H300 B90\nM666 X0 Y0 Z0 A0 B0 ; {a comment}\nM92 X80 Y80 Z80\n"
    (tmp_path / "config.g").write_text(text)
    assert read_printer(tmp_path / "config.g").radius == 105
    (tmp_path / "config.g").write_text(text + line + "\n")
    with pytest.raises(InputError) as caught:
        read_printer(tmp_path / "config.g")
    assert "line 4" in caught.value.where
    assert f"Send {line.split()[0]} " in caught.value.next_step


@pytest.mark.parametrize(("kind", "step"), [("6", True), ("10", False), ("1", False)])
def test_other_kinematics_of_reprapfirmware_are_named(kind, step, tmp_path):
    text = f"M584 X0 Y1 Z2\nM669 K3 ; a comment K4\n  M669 N4 K{kind} A0:-1600:-130\n"
    with pytest.raises(InputError) as caught:
        read_printer(text_file(tmp_path, text, "config.g"))
    assert caught.value.where == "config.g, line 3"
    assert caught.value.found == f"'M669 K{kind}'"
    assert (caught.value.next_step is not None) == step


REPRAP = "M665 L270.5:270.5:270.5 R105.5 H300.5 B90 X0.2 Y-0.1 Z0.3\nM666 X-0.25 Y0 Z-1.5 A0 B0\n"


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("config.g", changed(REPRAP, "R105.5", "R105,5"), 1),
        ("config.g", changed(REPRAP, "X-0.25", "X"), 2),
        ("config.g", changed(REPRAP, "Z-1.5", "Znan"), 2),
        ("config.g", REPRAP + "M92 X80 Y80 Z8e1\n", 3),
        ("config.g", REPRAP + "M92 X80 Y80 Z0\n", 3),
        ("eeprom.txt", changed(REPETIER, "EPR:1 893 20", "EPR:1 893 "), 6),
        ("eeprom.txt", changed(REPETIER, "EPR:1 893 20", "EPR:1 8 93  20"), None),
        ("eeprom.txt", changed(REPETIER, "EPR:3 941 0.400", "EPR:3 941"), 15),
    ],
)
def test_a_damaged_value_is_no_default(name, text, line, tmp_path):
    """A value whose text is damaged is neither cut nor left at its default."""
    with pytest.raises(InputError) as caught:
        read_printer(text_file(tmp_path, text, name))
    assert caught.value.where == (name if line is None else f"{name}, line {line}")


@pytest.mark.parametrize(
    "raw",
    [
        b"EPR:1 294 210 Extr.1 Preheat temp. [\xb0C]\r\n" + REPETIER.encode(),
        REPETIER.encode("utf-16"),
        codecs.BOM_UTF16_BE + REPETIER.replace("\n", "\r\n").encode("utf-16-be"),
        codecs.BOM_UTF8 + REPETIER.encode(),
    ],
)
def test_logs_in_the_encodings_of_hosts_and_shells(raw, tmp_path):
    """A degree sign in Latin-1, as firmwares print it, and what Windows' shell saves."""
    (tmp_path / "eeprom.txt").write_bytes(raw)
    assert read_printer(tmp_path / "eeprom.txt").radius == 105.0


@pytest.mark.parametrize("raw", [b"\x89PNG\r\n", bytes(range(256)), REPETIER.encode("utf-16-le")])
def test_what_is_no_text_is_no_printer(raw, tmp_path):
    (tmp_path / "eeprom.txt").write_bytes(raw)
    with pytest.raises(InputError) as caught:
        read_printer(tmp_path / "eeprom.txt")
    assert caught.value.code == "file.not_text"


def test_a_print_radius_beyond_the_rods_is_refused(tmp_path):
    printer = read_printer(text_file(tmp_path, changed(REPETIER, "925 90.000", "925 9000")))
    with pytest.raises(InputError) as caught:
        nominal_text(printer)
    assert caught.value.where == "printer.txt"


def test_printers_in_metres_are_refused(tmp_path):
    text = re.sub(
        r"\d+\.\d+(?=[^\n]*mm\])", lambda number: f"{float(number[0]) / 1e3:.6f}", REPETIER
    )
    with pytest.raises(InputError) as caught:
        read_printer(text_file(tmp_path, text))
    assert caught.value.code == "printer.units"
