"""Marlin: printers read from M503 and Configuration.h, exported values by Marlin's own forward
kinematics, and files that show no firmware or two.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import printers
from conftest import run
from dialects import HEIGHT_OFFSET, carried, commands, marlin, perturbed
from export_sources import source_of
from faults import raises
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.exporters.delta_texts import read_firmware_from_base
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.probed import read_measured
from pkmcal.firmware.session import heights_texts, nominal_text, write_printer_session
from pkmcal.geometry.rigid import apply
from pkmcal.mechanisms import load_mechanism

M503 = """\
Send: M503
Recv: echo:  G21    ; Units in mm (mm)
Recv: echo:; Steps per unit:
Recv: echo: M92 X80.00 Y80.00 Z100.00 E412.99
Recv: echo:; Endstop adjustment:
Recv: echo:  M666 X-0.2500 Y0.0000 Z-1.5000
Recv: echo:; Delta settings: L<diagonal rod> R<radius> H<height> S<segments per sec> XYZ<tower\
 angle trim> ABC<rod trim>
Recv: echo:  M665 L270.0000 R105.0000 H284.0000 S200.0000 X0.2000 Y-0.1000 Z0.3000 A0.1000 B-0.2000\
 C0.4000
Recv: echo:; PID settings:
Recv: echo:  M301 P16.51 I0.89 D76.10
Recv: echo:; Z-Probe Offset (mm):
Recv: echo:  M851 X10.0000 Y-20.0000 Z-16.0000
Recv: ok
"""
OLDER = """\
echo:Endstop adjustment:
echo:  M666 X-0.25 Y0.00 Z-1.50
echo:Delta settings: L<diagonal_rod> R<radius> H<height> S<segments_per_s> B<calibration radius>
echo:  M665 L270.00 R105.00 H300.00 S160.00 B80.00 X0.20 Y-0.10 Z0.30
echo:Z-Probe Offset (mm):
echo:  M851 Z-16.00
"""
OLDEST = """\
17:19:24.459 : echo:Delta settings: L=diagonal_rod, R=radius, S=segments_per_second, ABC=trim
17:19:24.482 : echo:  M665 L278.00 R145.50 S100.00 A0.00 B0.00 C0.00
"""
CONFIGURATION = """\
#ifndef CONFIGURATION_H
#define CONFIGURATION_H_VERSION 02010205
//#define DELTA_RADIUS 99.0
#define DELTA
  #define DELTA_DIAGONAL_ROD 270.0      // (mm)
  #define DELTA_SMOOTH_ROD_OFFSET 160.0 /* (mm)
  #define DELTA_DIAGONAL_ROD 1.0 */
  #define EFFECTOR 30.0
  #define DELTA_RADIUS ((DELTA_SMOOTH_ROD_OFFSET)-(EFFECTOR)-25)
  #define DELTA_HEIGHT 284.00
  #define DELTA_PRINTABLE_RADIUS 90.0
  #define DELTA_ENDSTOP_ADJ { -0.25, 0.0, -1.5 }
  #define DELTA_TOWER_ANGLE_TRIM { 0.2, -0.1, 0.3 }
  //#define DELTA_RADIUS_TRIM_TOWER { 1.0, 2.0, 3.0 }
  #define DELTA_DIAGONAL_ROD_TRIM_TOWER { 0.1, -0.2, 0.4 }
#define FIX_MOUNTED_PROBE
#define NOZZLE_TO_PROBE_OFFSET { 10, -20, -16 }
#define DEFAULT_AXIS_STEPS_PER_UNIT { 80, 80, 100, 412.99 }
"""


def text_file(folder, text, name="printer.txt"):
    path = folder / name
    path.write_text(text)
    return path


def machine_of(folder, printer):
    return load_mechanism(text_file(folder, nominal_text(printer), "m.yaml"))


# ------------------------------------------------------------------ writing


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.001, 0.9995, 1.0)])
def test_steps_are_corrected_where_readings_are_off(scale):
    machine, rng = perturbed(5, scale)
    (text,) = make_export(source_of(machine), "marlin").files.values()
    values = commands(text)
    assert max(values["666" + c] for c in "XYZ") <= 0
    if scale[0] == 1.0:
        assert "92X" not in values
        return
    np.testing.assert_allclose([values["92" + c] for c in "XYZ"], 80 / np.array(scale), atol=1e-4)
    # a motor goes as far as its command says with these steps
    delta = marlin(text, HEIGHT_OFFSET)
    travel = carried(machine, rng)
    there = machine.forward(machine.joint_ranges[:, 1] + travel)[:, :3, 3]
    there = 1e3 * apply(read_firmware_from_base(text), there)
    carriages = delta.homed + 1e3 * travel * np.array(scale)
    np.testing.assert_allclose(delta.tool(carriages), there, atol=1e-3)


# ------------------------------------------------------------------ reading


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


@pytest.mark.parametrize(
    "text",
    [
        M503,
        M503.replace("Recv: ", ""),
        M503.replace("Recv: ", "# RECV: "),
        M503.replace("Recv: ", "// "),
        M503.replace("Recv: ", "17:19:24.459 : "),
        CONFIGURATION,
    ],
)
def test_a_printer_is_read(text, tmp_path):
    printer = read_printer(text_file(tmp_path, text))
    assert printer.firmware.name == "marlin"
    assert printer.radius == 105.0
    np.testing.assert_allclose(printer.angle, [210.2, 329.9, 90.3])
    np.testing.assert_allclose(printer.rod, [270.1, 269.8, 270.4])
    # a negative offset retracts a carriage that triggered higher
    height = 284 + 16
    want = height + np.sqrt(printer.rod**2 - 105**2) + [0.25, 0.0, 1.5]
    np.testing.assert_allclose(printer.homed, want)
    assert printer.offset == (10.0, -20.0, -16.0)
    assert printer.height_offset == -16.0
    assert printer.steps.tolist() == [80.0, 80.0, 100.0]
    assert printer.reach == (90.0 if text is CONFIGURATION else None)
    # towards the tower at the front left its carriage rises
    left = printer.carriages(np.array([[-10.0, -6.0, 0.0]]))[0]
    assert left[0] > left[1:].max()


def test_expressions_are_those_of_c(tmp_path):
    """Integers divide as integers; the values of extruders are not looked at."""
    text = changed(CONFIGURATION, "{ 80, 80, 100, 412.99 }", "{ STEPS, STEPS, 2*STEPS, NONE }")
    text += "#define STEPS ((200) * 16 / double(PITCH) / double(20))\n#define PITCH 5/2\n"
    text += "".join(f"#define A{k} {'+'.join(60 * [f'A{k + 1}'])}\n" for k in range(7))
    text += "#define A7 0\n#define OTHER A0\n"
    text = changed(text, "EFFECTOR 30.0", "EFFECTOR (30+A0)")
    printer = read_printer(text_file(tmp_path, text))
    assert printer.steps.tolist() == [80.0, 80.0, 160.0]
    assert printer.radius == 105.0


def test_branches_that_do_not_hold_are_skipped(tmp_path):
    """Where a condition cannot be evaluated, two values are refused."""
    inner = "#define PRINTABLE_RADIUS 82.0f\n"
    branches = (
        "#if ENABLED(POLAR) || PROBES >= 3\n" + inner + "#elif defined(DELTA) && !ENABLED(SCARA)\n"
        "#define PROBES 2\n#if PROBES == 2\n#define PRINTABLE_RADIUS 77.0\n#else\n" + inner
        + "#endif\n#else\n" + inner + "#endif\n"
    )  # fmt: skip
    text = changed(CONFIGURATION, "  #define DELTA_PRINTABLE_RADIUS 90.0\n", "")
    assert read_printer(text_file(tmp_path, text + branches)).reach == 77.0
    odd = "#if odd @ condition\n#define DELTA_HEIGHT 99\n#endif\n"
    with pytest.raises(InputError) as caught:
        read_printer(text_file(tmp_path, text + odd))
    assert caught.value.expected == "one definition"
    assert "99" in caught.value.found


def test_without_a_probe_h_is_the_nozzles_height(tmp_path):
    """Configuration.h has an offset of the probe without a probe as well."""
    text = changed(CONFIGURATION, "#define FIX_MOUNTED_PROBE\n", "")
    printer = read_printer(text_file(tmp_path, text))
    assert printer.height_offset == 0.0
    np.testing.assert_allclose(printer.homed[1], 284 + np.sqrt(printer.rod[1] ** 2 - 105**2))


def test_b_alone_is_no_rods_trim(tmp_path):
    printer = read_printer(text_file(tmp_path, OLDER))
    np.testing.assert_allclose(printer.rod, [270.0] * 3)
    np.testing.assert_allclose(
        printer.homed, 300 + np.sqrt(270.0**2 - 105**2) + np.array([0.25, 0.0, 1.5])
    )
    assert printer.height_offset == 0.0
    assert "workspace_radius" not in nominal_text(printer)


@pytest.mark.parametrize("text", [M503, OLDER, CONFIGURATION])
def test_nominal_values_come_back(text, tmp_path):
    machine = machine_of(tmp_path, read_printer(text_file(tmp_path, text)))
    (out,) = make_export(source_of(machine), "marlin").files.values()
    values = commands(out)
    assert values["665R"] == pytest.approx(105, abs=2e-4)
    assert values["665H"] == pytest.approx(300 if text is OLDER else 284, abs=2e-4)
    for letter, value in zip("XYZ", (0.2, -0.1, 0.3), strict=True):
        assert values["665" + letter] == pytest.approx(value, abs=2e-4)
    trims = (0.0,) * 3 if text is OLDER else (0.1, -0.2, 0.4)
    for letter, value in zip("ABC", trims, strict=True):
        assert values["665L"] + values["665" + letter] == pytest.approx(270 + value, abs=2e-4)
    for letter, value in zip("XYZ", (-0.25, 0.0, -1.5), strict=True):
        assert values["666" + letter] == pytest.approx(value, abs=2e-4)
    assert "M500" in out.splitlines()
    if text is CONFIGURATION:
        assert "#define DELTA_PRINTABLE_RADIUS 90" in out
    # a file of values is read as it was written
    again = read_printer(text_file(tmp_path, out, "again.gcode"))
    np.testing.assert_allclose(again.rod, 270 + np.array(trims), atol=2e-4)


def test_missing_end_switch_offsets_are_a_remark(tmp_path):
    text = "\n".join(line for line in M503.splitlines() if "M666" not in line)
    assert [("M666" in one) for one in read_printer(text_file(tmp_path, text)).remarks] == [True]


def test_the_height_at_home_had_another_name(tmp_path):
    """Until 1.1.0; later configurations define it by DELTA_HEIGHT."""
    text = CONFIGURATION.replace("DELTA_HEIGHT 284.00", "MANUAL_Z_HOME_POS 284.00")
    old = read_printer(text_file(tmp_path, text))
    both = text + "#define DELTA_HEIGHT 284.0\n#define MANUAL_Z_HOME_POS DELTA_HEIGHT\n"
    both = both.replace("#define MANUAL_Z_HOME_POS 284.00\n", "")
    for other in (CONFIGURATION, both):
        np.testing.assert_array_equal(old.homed, read_printer(text_file(tmp_path, other)).homed)


@pytest.mark.parametrize("text", [M503, OLDER])
def test_h_keeps_the_convention_in_which_it_was_read(text, tmp_path):
    """Carriages that are half a millimetre higher at home put the nozzle as much higher."""
    machine = machine_of(tmp_path, read_printer(text_file(tmp_path, text)))
    values = machine.values.copy()
    for leg in (1, 2, 3):
        values[machine.parameters.index(f"legs[{leg}].base.center.z")] += 5e-4
    raised = machine.with_values(values)
    before, after = (
        commands(*make_export(source_of(one), "marlin").files.values())["665H"]
        for one in (machine, raised)
    )
    assert after - before == pytest.approx(0.5, abs=2e-4)


@pytest.mark.parametrize("to", ["marlin", "klipper"])
def test_the_other_assembly_mode_is_not_compared(to, tmp_path):
    """Without a print radius carriages go as low as a tool between the towers needs, where a rod
    can lie beyond the horizontal."""
    text = M503.replace("L270.0000 R105.0000 H284.0000", "L280 R141.9439 H354.3339")
    machine = machine_of(tmp_path, read_printer(text_file(tmp_path, text)))
    made = make_export(source_of(machine), to)
    assert made.differences[0].largest < 1e-6


def test_without_the_convention_there_is_no_h():
    """An H of the other convention drives the nozzle into the bed."""
    machine, _ = perturbed(3)
    unknown = replace(machine, document=machine.document.model_copy(update={"height_offset": None}))
    (text,) = make_export(source_of(unknown), "marlin").files.values()
    values = commands(text)
    assert "665H" not in values
    assert "M500" not in text.splitlines()
    assert "DELTA_HEIGHT" not in text
    # the file gives the height at home in words
    height = float(re.search(r"Height of the nozzle at home: ([\d.]+) mm", text)[1])
    (with_h,) = make_export(source_of(machine), "marlin").files.values()
    assert commands(with_h)["665H"] == pytest.approx(height - 16, abs=1e-4)


def test_small_offsets_are_not_left_to_be_ignored():
    """Of switches 0.05 mm apart, all carriages retract."""
    machine = printers.machine(printers.Settings(), endstops=(0.0, 0.05, 0.0))
    (text,) = make_export(source_of(machine), "marlin").files.values()
    values = commands(text)
    offset = np.array([values["666" + c] for c in "XYZ"])
    np.testing.assert_allclose(offset, [-0.2, -0.25, -0.2], atol=1e-3)


# ------------------------------------------------------------------ points of the bed


def bed_lines(points):
    return "".join(f"Recv: Bed X: {x:.3f} Y: {y:.3f} Z: {z:.3f}\n" for x, y, z in points)


def test_points_are_those_under_the_probe(tmp_path):
    printer = read_printer(text_file(tmp_path, M503))
    points = np.array([[10.0, -20.0, 0.1], [40.0, 10.0, -0.2], [40.0, 10.0, -0.4]])
    touches = read_measured(text_file(tmp_path, bed_lines(points), "log.txt"), printer)[0]
    tool = np.array([[0.0, 0.0, 16.1], [30.0, 30.0, 15.7]])
    np.testing.assert_allclose(touches.carriages, printer.carriages(tool))
    np.testing.assert_allclose(touches.heights, [16.0, 16.0])


def test_a_log_of_settings_and_points_is_a_session(tmp_path):
    """A printer whose radius is 0.4 mm larger than Marlin's, from its log to H, R and M666."""
    text = M503.replace("X10.0000 Y-20.0000 Z-16.0000", "X0 Y0 Z-16")
    firmware = read_printer(text_file(tmp_path, text))
    settings = printers.Settings(
        105.0, tuple(firmware.angle), tuple(firmware.rod), (300.25, 300.0, 301.5)
    )
    true = printers.machine(replace(settings, radius=105.4), endstops=(0.3, -0.2, 0.1))
    readings = printers.felt(true, printers.bed(19), 0.01, np.random.default_rng(1))
    tool = 1e3 * printers.machine(settings).forward(1e-3 * readings)[:, :3, 3]
    log = text_file(tmp_path, text + bed_lines(tool - [0, 0, 0]))
    # the probe hangs 16 mm below the nozzle, which is then as high above the bed
    kit = tmp_path / "kit"
    written = write_printer_session(kit, log)
    assert "poses.csv" in written
    assert run("calibrate", kit).code == 0
    assert run("export", kit / "calibration", "--to", "marlin").code == 0
    (path,) = (kit / "export-marlin").iterdir()
    # at other places the nozzle is at the height that Marlin commands
    there = printers.machine(replace(settings, radius=105.4), endstops=(0.3, -0.2, 0.1))
    points = np.column_stack([0.8 * printers.bed(19)[:, ::-1] + 2, np.full(19, 0.0)])
    delta = marlin(path.read_text(), HEIGHT_OFFSET)
    a = np.deg2rad(delta.angle)
    towers = delta.radius * np.column_stack([np.cos(a), np.sin(a)])
    off = points[:, None, :2] - towers
    travel = delta.homed - np.sqrt(delta.rod**2 - np.sum(off**2, axis=-1))
    heights = 1e3 * there.forward(1e-3 * (settings.homed - travel))[:, 2, 3]
    assert np.abs(tool[:, 2]).max() > 0.25
    assert np.sqrt(np.mean(heights**2)) < 0.015


def grid_lines(z, command):
    """A grid (rows along y) as M420 V prints it behind a G29."""
    lines = [f"Send: N7 {command}*42", "Recv: Bilinear Leveling Grid:"]
    lines.append("Recv:  " + "".join(f"{k:7d}" for k in range(z.shape[1])))
    lines += [f"Recv: {k:2d}" + "".join(f" {value:+.3f}" for value in row)
              for k, row in enumerate(z)]  # fmt: skip
    return "\n".join([*lines, "Recv: ", "Recv: ok"]) + "\n"


def test_a_grid_has_the_places_of_its_command(tmp_path):
    """Without the corners, which Marlin extrapolates where a probe 22 mm aside does not reach."""
    x, y = np.linspace(-65, 65, 7), np.linspace(-60, 60, 6)
    there = np.stack(np.meshgrid(x, y), axis=-1)
    z = 0.2 + 1e-3 * there[..., 0] + 2e-3 * there[..., 1]
    # print radius 90 mm, margin 10 mm
    reached = np.linalg.norm(there, axis=-1) <= 80
    reached &= np.linalg.norm(there - [10, -20], axis=-1) <= 90
    assert not reached.all()
    text = grid_lines(np.where(reached, z, 9.0), "G29 L-65 R65 F-60 B60")
    printer = read_printer(text_file(tmp_path, M503))
    log = text_file(tmp_path, "Send: G29 L-1 R1 F-1 B1\n" + text, "log.txt")
    touches, _ = read_measured(log, printer)
    true = printers.Settings(105.0, tuple(printer.angle), tuple(printer.rod))
    tool = 1e3 * printers.machine(true).forward(1e-3 * touches.carriages)[:, :3, 3]
    probe = tool + np.array([10, -20, 0])
    np.testing.assert_allclose(probe[:, 2], 0.2 + probe[:, :2] @ [1e-3, 2e-3], atol=6e-4)
    assert 20 <= len(probe) <= reached.sum()
    assert np.linalg.norm(probe[:, :2], axis=1).max() > 60


@pytest.mark.parametrize(("size", "most"), [("120", 90), ("121.9", 90), ("128", 90), ("120", None)])
def test_a_square_grid_is_read_where_the_print_radius_holds_it(size, most, tmp_path):
    """G29 H: Marlin cuts a larger square at the probe's reach without a mark."""
    half = int(float(size)) // 2
    low, high = -half, int(float(size)) - half
    x = np.linspace(low, high, 5)
    there = np.stack(np.meshgrid(x, x), axis=-1)
    text = grid_lines(1e-3 * there[..., 0] + 2e-3 * there[..., 1], f"G29 H{size}")
    printer = replace(
        read_printer(text_file(tmp_path, CONFIGURATION, "Configuration.h")), reach=most
    )
    log = text_file(tmp_path, text, "log.txt")
    if most is None or np.sqrt(2) * half > most:
        with pytest.raises(InputError) as caught:
            read_measured(log, printer)
        assert "G29 L R F B" in caught.value.expected
        return
    touches, _ = read_measured(log, printer)
    true = printers.Settings(105.0, tuple(printer.angle), tuple(printer.rod))
    tool = 1e3 * printers.machine(true).forward(1e-3 * touches.carriages)[:, :3, 3]
    probe = tool + np.array([10, -20, 0])
    np.testing.assert_allclose(probe[:, 2], probe[:, :2] @ [1e-3, 2e-3], atol=6e-4)
    assert probe[:, 0].min() == pytest.approx(low, abs=1e-6)


G33 = """\
Send: G33 P3 V0
Recv: G33 Auto Calibrate
Recv: Checking... AC at radius:80.00 (DRY-RUN)
Recv: .Height:284.00  Ex:-0.25  Ey:0.00  Ez:-1.50  Radius:105.00
Recv: .              Tx:+0.20  Ty:-0.10  Tz:+0.30
Recv: .      c:+0.10   x:-0.20   y:+0.30   z:-0.40
Recv: .             yz:+0.50  zx:-0.60  xy:+0.70
Recv: End DRY-RUN                                   std dev:0.437
"""


@pytest.mark.parametrize(("command", "offset"), [("G33 P3 V0", (0, 0)), ("G33 P3 V0 O", (10, -20))])
def test_a_dry_run_of_g33_has_seven_places(command, offset, tmp_path):
    """By its radius; with O the probe goes there, not the nozzle."""
    printer = read_printer(text_file(tmp_path, M503))
    log = text_file(tmp_path, G33.replace("G33 P3 V0", command), "log.txt")
    touches, _ = read_measured(log, printer)
    true = printers.Settings(105.0, tuple(printer.angle), tuple(printer.rod))
    tool = 1e3 * printers.machine(true).forward(1e-3 * touches.carriages)[:, :3, 3]
    turn = {"x": 210, "xy": 270, "y": 330, "yz": 30, "z": 90, "zx": 150}
    heights = {"x": -0.2, "y": 0.3, "z": -0.4, "yz": 0.5, "zx": -0.6, "xy": 0.7}
    want = [[0, 0, 0.1]]
    want += [
        [80 * np.cos(np.deg2rad(turn[k])), 80 * np.sin(np.deg2rad(turn[k])), z]
        for k, z in heights.items()
    ]
    order = np.lexsort(np.round(want, 6).T)
    mine = tool + np.array([*offset, 0])
    np.testing.assert_allclose(
        mine[np.lexsort(np.round(mine, 6).T)], np.array(want)[order], atol=1e-6
    )


def test_a_g33_that_prints_no_radius_has_that_of_m665(tmp_path):
    """B of M665 up to 2.0.5; beside A and C it is a rod's trim, and no radius."""
    printer = read_printer(text_file(tmp_path, OLDER.replace("Z-16", "X0 Y0 Z-16")))
    silent = without(G33, " at radius:80.00")
    same = [
        read_measured(text_file(tmp_path, text, "log.txt"), printer)[0].carriages
        for text in (G33, OLDER + silent)
    ]
    np.testing.assert_allclose(*same)
    for text in (silent, M503 + silent):
        with pytest.raises(InputError):
            read_measured(text_file(tmp_path, text, "log.txt"), printer)


def test_m48_is_the_noise(tmp_path):
    printer = read_printer(text_file(tmp_path, M503))
    text = "Recv: Finished!\nRecv: Mean: 0.01 Min: 0.0 Max: 0.1 Range: 0.1\n"
    text += "Recv: Standard Deviation: 0.002500\n" + bed_lines(np.eye(3))
    touches, _ = read_measured(text_file(tmp_path, text, "log.txt"), printer)
    assert touches.sigma == 0.0025


def without(text, word):
    assert word in text
    return text.replace(word, "")


@pytest.mark.parametrize(
    "text",
    [
        "Bilinear Leveling Grid:\n      0      1\n 0 +0.010 +0.020\n",
        grid_lines(np.zeros((3, 3)), "G29"),
        grid_lines(np.zeros((3, 3)), "G29 L-60 R60 F-60"),
        "Bed Topography Report:\n",
        "Mesh Bed Leveling:\nNum X,Y: 3,3\nMeasured points:\n        0         1\n",
        "G33 Auto Calibrate\nChecking... AC\n.    c:+0.10  x:+0.02  y:-0.01  z:+0.00\n",
        without(G33, " at radius:80.00"),
        without(G33, " (DRY-RUN)"),
        without(G33, "P3 "),
        without(G33, "z:-0.40"),
        G33.replace("P3", "P4"),
    ],
)
def test_heights_without_places_are_refused_with_what_to_do(text, tmp_path):
    printer = read_printer(text_file(tmp_path, M503))
    with pytest.raises(InputError) as caught:
        read_measured(text_file(tmp_path, text, "log.txt"), printer)[0]
    assert "G29 V4" in caught.value.next_step


def test_points_of_a_probe_somewhere_are_refused(tmp_path):
    """M851 of older versions has no X and Y."""
    path = text_file(tmp_path, OLDER + bed_lines(np.zeros((7, 3))))
    with pytest.raises(InputError) as caught:
        read_measured(path, read_printer(path), own=True)
    assert "M851 X Y Z" in caught.value.expected


# ------------------------------------------------------------------ which firmware


PLAIN = "M665 L270 R105 H300 X0.1 Y0.2 Z0\nM666 X0 Y-0.1 Z-0.2\n"
CLAIMS = {
    "M503": (M503, "marlin"),
    "older": (OLDER, "marlin"),
    "configuration": (CONFIGURATION, "marlin"),
    "rod trims": ("M665 L270 R105 H300 A0 B0 C0.1\n", "marlin"),
    "segments": ("M665 L270 R105 H300 S100\n", "marlin"),
    "probe": (PLAIN + "M851 X0 Y0 Z-1.5\n", "marlin"),
    "own name": ("FIRMWARE_NAME:Marlin 2.1.2\n" + PLAIN, "marlin"),
    "rods": ("M665 L270:270:271 R105 H300 B90\n", "reprap"),
    "tilt": ("M665 L270 R105 H300 B90\nM666 X0 Y0 Z0 A0.1 B0\n", "reprap"),
    "drivers": ("M569 P0 S1\nM665 L270 R105 H300 B90\n", "reprap"),
    "heading": ("; Configuration file for RepRapFirmware\n; Delta Settings\n" + PLAIN, "reprap"),
    "cfg": (printers.printer_cfg(printers.Settings()), "klipper"),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_one_firmware_claims_a_file(name, tmp_path):
    text, firmware = CLAIMS[name]
    path = text_file(tmp_path, text)
    assert read_printer(path).firmware.name == firmware
    assert read_printer(path, firmware).firmware.name == firmware


def test_ambiguous_commands_are_not_guessed(tmp_path):
    """The end switches' offsets of Marlin and RepRapFirmware have opposite signs."""
    path = text_file(tmp_path, PLAIN.replace("H300", "H300 B90"))
    with pytest.raises(InputError) as caught:
        read_printer(path)
    assert "--firmware" in caught.value.next_step
    rise = np.sqrt(270.0**2 - 105.0**2)
    offsets = np.array([0.0, -0.1, -0.2])
    np.testing.assert_allclose(read_printer(path, "marlin").homed, 300 + rise - offsets)
    np.testing.assert_allclose(read_printer(path, "reprap").homed, 300 + rise + offsets)
    # the name config.g is RepRapFirmware's
    named = text_file(tmp_path, path.read_text(), "config.g")
    assert read_printer(named).firmware.name == "reprap"
    done = run("new", tmp_path / "kit", "--printer", path, "--board", "--firmware", "marlin")
    assert done.code == 0, done.err
    assert "--to" not in done.err


def test_two_claims_are_named_with_their_reasons(tmp_path):
    path = text_file(tmp_path, "M569 P0 S1\nM665 L270 R105 H300 A0 B0 C0\n")
    with pytest.raises(InputError) as caught:
        read_printer(path)
    for word in ("Marlin (line", "RepRapFirmware (line 1 has M569 P)"):
        assert word in caught.value.found
    assert "--firmware marlin or reprap" in caught.value.next_step
    assert read_printer(path, "marlin").firmware.name == "marlin"


@pytest.mark.parametrize("firmware", ["reprap", "klipper", "marlyn", ""])
def test_a_firmware_that_the_file_denies_is_refused(firmware, tmp_path):
    with pytest.raises(InputError):
        read_printer(text_file(tmp_path, M503), firmware)


def test_a_firmware_is_named_for_a_printer():
    assert run("new", "nowhere", "--firmware", "marlin").code == 2


# ------------------------------------------------------------------ what cannot be read


WRONG = {
    "\n".join(line for line in M503.splitlines() if "M665" not in line): {
        "where": "printer.txt",
        "expected": "the line M665 that M503 prints, with L, R and H",
    },
    OLDEST: {"where": "printer.txt, line 2", "found": "M665 without H, as Marlin 1.1.0 prints it"},
    changed(M503, "Y0.0000 Z-1.5", "Y0.5000 Z-1.5"): {
        "where": "printer.txt, line 6",
        "found": "0.5",
        "expected": "at most 0, as Marlin takes it",
    },
    changed(M503, "R105.0000", "R-105"): {
        "where": "printer.txt, line 8",
        "found": "-105",
        "expected": "above 0",
    },
    changed(M503, "R105.0000", "Rnan"): {
        "where": "printer.txt, line 8",
        "found": "'M665 L270.0000 Rnan H284.0000 S200.0000 X0.2000 Y-0.1000 Z…",
    },
    changed(M503, "R105.0000", "R1e999"): {
        "where": "printer.txt, line 8",
        "found": "'M665 L270.0000 R1e999 H284.0000 S200.0000 X0.2000 Y-0.1000…",
    },
    changed(M503, "R105.0000", "R10:5"): {
        "where": "printer.txt, line 8",
        "found": "'M665 L270.0000 R10:5 H284.0000 S200.0000 X0.2000 Y-0.1000 …",
    },
    changed(M503, "R105.0000", "R300"): {
        "where": "printer.txt",
        "found": "rods of 269.8 mm, a radius of 300 mm",
        "expected": "both in mm, as the firmware has them",
    },
    changed(M503, "L270.0000", ""): {
        "where": "printer.txt",
        "expected": "the line M665 that M503 prints, with L, R and H",
    },
    changed(M503, "M92 X80.00", "M92 X0"): {
        "where": "printer.txt, line 4",
        "found": "0",
        "expected": "above 0",
    },
    changed(M503, "G21", "G20"): {"where": "printer.txt, line 2", "expected": "G21, millimetres"},
    M503 + "echo:  M206 X1.00 Y0.00 Z0.00\n": {
        "where": "printer.txt, line 14",
        "found": "1",
        "expected": "0",
    },
    changed(CONFIGURATION, "#define DELTA_HEIGHT 284.00", ""): {
        "where": "printer.txt",
        "expected": "#define DELTA_HEIGHT with a number",
    },
    CONFIGURATION + "#define DELTA_HEIGHT 285.00\n": {
        "where": "printer.txt, lines 10 and 19",
        "found": "'284.00' and '285.00'",
        "expected": "one definition",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR DELTA_RADIUS"): {
        "where": "printer.txt, line 9",
        "found": "'((DELTA_SMOOTH_ROD_OFFSET)-(EFFECTOR)-25)'",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR " + 900 * "("): {
        "where": "printer.txt, line 8",
        "found": "'((((((((((((((((((((((((((((((((((((((((((((((((((((((((((…",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR " + 200_000 * "("): {
        "where": "printer.txt, line 8",
        "found": "'((((((((((((((((((((((((((((((((((((((((((((((((((((((((((…",
    },
    changed(CONFIGURATION, "#define DELTA\n", "#if ENABLED(DELTA)\n"): {
        "where": "printer.txt",
        "found": "'#if ENABLED(DELTA)' without #define DELTA",
        "expected": "#define DELTA",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR 1/0"): {
        "where": "printer.txt, line 8",
        "found": "'1/0'",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR 9**9**9"): {
        "where": "printer.txt, line 8",
        "found": "'9**9**9'",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "EFFECTOR exit()"): {
        "where": "printer.txt, line 8",
        "found": "'exit()'",
    },
    changed(CONFIGURATION, "EFFECTOR 30.0", "OTHER 30.0"): {
        "where": "printer.txt",
        "expected": "#define EFFECTOR with a number",
    },
    changed(CONFIGURATION, "//#define DELTA_RADIUS_TRIM", "#define DELTA_RADIUS_TRIM"): {
        "where": "printer.txt, line 14",
        "found": "1, 2, 3 mm",
    },
    changed(CONFIGURATION, "{ -0.25, 0.0, -1.5 }", "{ 0.5, 0.0, -1.5 }"): {
        "where": "printer.txt, line 12",
        "found": "0.5",
        "expected": "at most 0, as Marlin takes it",
    },
    changed(CONFIGURATION, "{ -0.25, 0.0, -1.5 }", "-1"): {
        "where": "printer.txt, line 12",
        "found": "'-1'",
    },
    changed(CONFIGURATION, "{ 80, 80, 100, 412.99 }", "{ 80, -80, 100 }"): {
        "where": "printer.txt, line 18",
        "found": "-80",
        "expected": "above 0",
    },
}


@pytest.mark.parametrize("text", WRONG, ids=[facts["where"] for facts in WRONG.values()])
def test_what_marlin_has_not_is_refused(text, tmp_path):
    with raises(InputError, **WRONG[text]):
        read_printer(text_file(tmp_path, text))


@pytest.mark.parametrize(
    "line",
    [
        "echo:" + 200_000 * " " + "x",
        200_000 * "/*",
        200_000 * "1 ",
        "N1" + 200_000 * " ",
        "recv" + 200_000 * ">",
        "M665 L" + 200_000 * "1" + ":",
        "Bed X: " + 200_000 * "1",
    ],
    ids=lambda line: line[:12],
)
def test_endless_lines_are_read_in_no_time(line, tmp_path):
    """Quadratic searches would take minutes; the suite's time limit is shorter."""
    path = text_file(tmp_path, line + "\n" + PLAIN)
    with pytest.raises(InputError):
        read_printer(path)


def test_a_wrong_number_of_steps_in_the_mechanism_file(tmp_path):
    printer = read_printer(text_file(tmp_path, M503))
    text = changed(nominal_text(printer), "[80, 80, 100]", "[80, 80]")
    with pytest.raises(InputError) as caught:
        load_mechanism(text_file(tmp_path, text, "m.yaml"))
    assert caught.value.where.endswith("steps_per_mm")
    assert caught.value.found == "2 numbers"


def test_steps_of_reprapfirmware_are_corrected(tmp_path):
    """M350 behind M92 changes the steps, which are then unknown."""
    head = "M584 X0\nM665 L270 R105 H300 B90\nM666 X0 Y0 Z0\n"
    text = head + "M350 X16 Y16 Z16 I1\nM92 X80 Y80 Z100\n"
    printer = read_printer(text_file(tmp_path, text, "config.g"))
    assert printer.steps.tolist() == [80.0, 80.0, 100.0]
    assert printer.step == 1 / 80
    machine = machine_of(tmp_path, printer)
    scales = machine.values.copy()
    scales[machine.parameters.index("legs[3].scale")] = 1.001
    (out,) = make_export(source_of(machine.with_values(scales)), "reprap").files.values()
    values = commands("\n".join(line for line in out.splitlines() if line.startswith("M92")))
    assert values["92Z"] == pytest.approx(100 / 1.001, abs=1e-4)
    later = head + "M92 X80 Y80 Z100\nM350 X16 Y16 Z16 I1\n"
    assert read_printer(text_file(tmp_path, later, "config.g")).steps is None
    with pytest.raises(InputError):
        read_printer(text_file(tmp_path, head + "M92 X0 Y80 Z100\n", "config.g"))


def test_a_session_of_heights_has_what_exports_keep(tmp_path):
    printer = read_printer(text_file(tmp_path, M503))
    points = [[x + 10, y - 20, 0.0] for x, y in printers.bed(7, 60.0)]
    touches = read_measured(text_file(tmp_path, bed_lines(points), "log.txt"), printer)[0]
    texts = heights_texts(printer, touches)
    assert "height_offset: -16 mm" in texts["mechanism.yaml"]
    assert "steps_per_mm: [80, 80, 100]" in texts["mechanism.yaml"]
    assert "--to marlin" in texts["session.yaml"]
