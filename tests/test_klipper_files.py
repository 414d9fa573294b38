"""Klipper's files: includes, saved values, meshes of the bed, and measurements in its console."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

import printers
from conftest import run
from distance_sessions import stretch
from faults import raises
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.errors import InputError
from pkmcal.files import read_csv
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.probed import read_measured

SAYS = printers.Settings()
CFG = printers.printer_cfg(SAYS)
PROBE = "[probe]\nx_offset: 12\ny_offset: -5.5\nz_offset: 1.25\n"


def files(folder, **texts):
    """Files by name, with two underscores for a folder and one for a dot; the first one's path."""
    paths = [folder / name.replace("__", "/").replace("_", ".") for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return paths[0]


def test_a_probe_without_its_height_is_a_remark(tmp_path):
    """Klipper requires z_offset, which may be in the saved block or in a file that is missing."""
    for text, remarks in ((PROBE, 0), (PROBE.replace("z_offset", "#z_offset"), 1)):
        printer = read_printer(files(tmp_path, printer_cfg=text + CFG))
        assert len(printer.remarks) == remarks


# ------------------------------------------------------------------ included files


def parts(text):
    """A printer.cfg without its steppers and its [printer], and these as texts."""
    head, _, tail = text.partition("[printer]\n")
    body, mark, saved = tail.partition("[gcode_macro")
    printer, *steppers = ("[printer]\n" + body).split("[stepper_")
    return head, printer, ["[stepper_" + one for one in steppers], mark + saved


def test_values_of_included_files(tmp_path):
    """The whole printer in files beside, by name, by wildcard, and by an included file."""
    head, printer, steppers, rest = parts(CFG)
    path = files(
        tmp_path,
        printer_cfg="[include towers/*.cfg]\n[include kinematics.cfg] # a comment\n" + head + rest,
        kinematics_cfg=printer + "[include parts/c.txt]\n",
        parts__c_txt=steppers[2],
        towers__a_cfg=steppers[0],
        towers__b_cfg=steppers[1],
    )
    whole = read_printer(files(tmp_path / "whole", whole_cfg=CFG))
    printer = read_printer(path)
    np.testing.assert_array_equal(printer.homed, whole.homed)
    np.testing.assert_array_equal(printer.rod, whole.rod)
    assert (printer.radius, printer.reach, printer.step) == (105.0, 90.0, whole.step)
    assert printer.remarks == ()


@pytest.mark.parametrize(
    ("text", "radius"),
    [
        ("[include r.cfg]\n" + CFG, 105.0),
        (CFG.replace("[gcode_macro", "[include r.cfg]\n\n[gcode_macro"), 106.0),
        (CFG.replace("delta_radius: 105.0\n", "") + "#*# [printer]\n#*# delta_radius = 99\n", None),
        (CFG + "#*# [printer]\n#*# delta_radius = 99\n", 105.0),
        (
            "[include r.cfg]\n"
            + CFG.replace("delta_radius: 105.0\n", "")
            + "#*# [printer]\n#*# delta_radius = 99\n",
            106.0,
        ),
    ],
)
def test_the_last_value_counts_and_saved_ones_least(text, radius, tmp_path):
    """As in Klipper's own reader; an included file stands where its line stands."""
    path = files(tmp_path, printer_cfg=text, r_cfg="[printer]\ndelta_radius: 106\n")
    assert read_printer(path).radius == (radius or 99.0)


def test_a_missing_include_is_named(tmp_path):
    path = files(tmp_path, printer_cfg="[include mainsail.cfg]\n[include macros/*.cfg]\n" + CFG)
    (remark,) = read_printer(path).remarks
    assert "printer.cfg, line 1 includes mainsail.cfg" in remark
    path.write_text("[include towers.cfg]\n" + CFG.replace("delta_radius", "#"))
    with pytest.raises(InputError) as caught:
        read_printer(path)
    assert "delta_radius" in caught.value.what
    assert "towers.cfg" in caught.value.next_step


WRONG_INCLUDES = {
    "itself": (
        {"printer_cfg": "[include printer.cfg]\n"}, "printer.include_circle",
        "printer.cfg, line 1"),
    "circle": (
        {"printer_cfg": "[include a.cfg]\n", "a_cfg": "\n[include b.cfg]\n",
         "b_cfg": "[include ./a.cfg]\n"}, "printer.include_circle", "b.cfg, line 1"),
    "far": (
        {"printer_cfg": "[include ../*/*.cfg]\n"}, "printer.include_wildcards",
        "printer.cfg, line 1"),
    "root": (
        {"printer_cfg": "[include /*]\n"}, "printer.include_wildcards", "printer.cfg, line 1"),
    "deep": (
        {"printer_cfg": "[include */*/*/*]\n"}, "printer.include_wildcards",
        "printer.cfg, line 1"),
    "twice and twice": (
        {"printer_cfg": "[include b.cfg]\n" * 8, "b_cfg": "[include c.cfg]\n" * 8,
         "c_cfg": "[x]\n"}, "printer.too_many_includes", "b.cfg, line 1"),
    "folder": (
        {"printer_cfg": "[include parts]\n", "parts__x_cfg": ""}, "file.irregular", "parts"),
    "no text": (
        {"printer_cfg": "[include x.cfg]\n", "x_cfg": "\0\1"}, "file.not_text", "x.cfg, line 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_INCLUDES)
def test_includes_that_cannot_be_followed(name, tmp_path):
    texts, code, where = WRONG_INCLUDES[name]
    with raises(InputError, code=code, where=where):
        read_printer(files(tmp_path, **texts))


def test_links_in_a_circle_take_no_time(tmp_path):
    for name in "ab":
        (tmp_path / name).symlink_to(tmp_path)
    path = files(tmp_path, printer_cfg=CFG + "")
    path.write_text("[include " + "*/" * 90 + "*]\n" + CFG)
    with pytest.raises(InputError) as error:
        read_printer(path)
    assert error.value.code == "printer.include_wildcards"


# ------------------------------------------------------------------ steps


def test_step_distance_of_older_files(tmp_path):
    """0.0125 mm a step: 40 mm a revolution of 200 times 16 steps."""
    carriages = np.tile(SAYS.homed - 250, (7, 1)) + np.arange(7)[:, None]
    text = printers.printer_cfg(SAYS, carriages)
    new = read_printer(files(tmp_path, printer_cfg=text))
    old = text.replace("rotation_distance: 40", "step_distance: .0125")
    printer = read_printer(files(tmp_path, old_cfg=old))
    assert printer.step == new.step == 0.0125
    np.testing.assert_allclose(printer.touches.carriages, carriages, atol=1e-4)
    assert "40 for a motor of 200 full steps, 80 for one of 400" in printer.remarks[0]
    known = old.replace("microsteps", "full_steps_per_rotation: 400\nmicrosteps")
    assert read_printer(files(tmp_path, old_cfg=known)).remarks[0].endswith(": 80.")
    # where both stand Klipper took rotation_distance
    both = text.replace("rotation_distance: 40", "rotation_distance: 20\nstep_distance: .0125")
    printer = read_printer(files(tmp_path, old_cfg=both))
    assert printer.step == 20 / 3200
    assert printer.remarks == ()


# ------------------------------------------------------------------ meshes


def bowl(x, y):
    """Z at which the nozzle would touch the bed with its probe at (x, y)."""
    return 0.1 + 2e-5 * (x**2 + 0.5 * y**2) - 1e-3 * x


def mesh_lines(count, half, middle=(0.0, 0.0), name="default", *, round_bed):
    """Klipper's saved mesh: on a round bed rows go on with their last probed values."""
    k = np.linspace(-half, half, count)
    rows = []
    for y in k:
        z = [bowl(middle[0] + x, middle[1] + y) for x in k]
        if round_bed:
            probed = [n for n, x in enumerate(k) if np.hypot(x, y) <= half + 1e-9]
            z = [z[min(max(n, probed[0]), probed[-1])] for n in range(count)]
        rows.append("#*# \t  " + ", ".join(f"{value:.6f}" for value in z))
    ends = {f"{end}_{c}": m + sign * half for c, m in zip("xy", middle, strict=True)
            for end, sign in (("min", -1), ("max", 1))}  # fmt: skip
    entries = {"version": 1, "x_count": count, "y_count": count, "algo": "lagrange", **ends}
    lines = [f"#*# [bed_mesh {name}]", "#*# points = ", *rows]
    return "\n".join([*lines, *(f"#*# {key} = {value}" for key, value in entries.items()), "#*#\n"])


ROUND = PROBE + "[bed_mesh]\nmesh_radius: 80\nround_probe_count: 7\n" + CFG


def tool_points(printer, touches):
    """Tool positions (n, 3) mm of touches with the bed at Z, and those of the probe."""
    tool = 1e3 * printers.machine(SAYS).forward(1e-3 * touches.carriages)[:, :3, 3]
    return tool, tool + np.array([*printer.offset[:2], 0.0])


@pytest.mark.parametrize("middle", [(0.0, 0.0), (3.0, -2.0)])
def test_only_probed_points_of_a_round_mesh_count(middle, tmp_path):
    path = files(tmp_path, printer_cfg=ROUND + mesh_lines(7, 79.98, middle, round_bed=True))
    printer = read_printer(path)
    touches, distances = read_measured(path, printer, own=True)
    _, probe = tool_points(printer, touches)
    k = np.linspace(-79.98, 79.98, 7)
    inside = sum(np.hypot(x, y) <= 79.98 + 1e-9 for x in k for y in k)
    assert len(probe) == inside == 29
    np.testing.assert_allclose(probe[:, 2], bowl(*probe[:, :2].T), atol=2e-6)
    assert np.hypot(*(probe[:, :2] - middle).T).max() == pytest.approx(79.98)
    np.testing.assert_array_equal(touches.heights, 0.0)
    assert "[bed_mesh default]" in touches.origin
    assert distances is None


def test_a_rectangular_mesh_without_its_faulty_region(tmp_path):
    region = "faulty_region_1_min: 30, 30\nfaulty_region_1_max: 60.0, 60.0\n"
    text = PROBE + "[bed_mesh]\nmesh_min: -50,-50\nmesh_max: 50,50\n" + region + CFG
    path = files(tmp_path, printer_cfg=text + mesh_lines(5, 50, round_bed=False))
    touches, _ = read_measured(path, read_printer(path), own=True)
    _, probe = tool_points(read_printer(path), touches)
    assert len(probe) == 24
    np.testing.assert_allclose(probe[:, 2], bowl(*probe[:, :2].T), atol=2e-6)
    assert not (probe[:, :2] > 30).all(axis=1).any()


def test_a_session_of_a_mesh(tmp_path):
    """printer.cfg alone is enough; DELTA_CALIBRATE's own points come before a mesh."""
    text = ROUND + mesh_lines(7, 78, round_bed=True)
    path = files(tmp_path, printer_cfg=text)
    assert run("new", tmp_path / "kit", "--printer", path).code == 0
    assert read_csv(tmp_path / "kit" / "poses.csv", columns=("z",)).values.shape == (29, 1)
    assert "[bed_mesh default]" in (tmp_path / "kit" / "session.yaml").read_text()
    readings = printers.felt(printers.machine(SAYS), printers.bed(7), 0.0, np.random.default_rng(1))
    path.write_text(
        PROBE + "[bed_mesh]\nmesh_radius: 80\n" + printers.printer_cfg(SAYS, readings)
        + mesh_lines(7, 78, round_bed=True)
    )  # fmt: skip
    assert run("new", tmp_path / "seven", "--printer", path).code == 0
    assert read_csv(tmp_path / "seven" / "poses.csv", columns=("z",)).values.shape == (7, 1)
    # named with --probed, the same file is read for its mesh
    assert run("new", tmp_path / "mesh", "--printer", path, "--probed", path).code == 0
    assert read_csv(tmp_path / "mesh" / "poses.csv", columns=("z",)).values.shape == (29, 1)


MESH = mesh_lines(5, 60, round_bed=False)
WRONG_MESHES = {
    CFG + MESH: "printer.cfg, [bed_mesh default]",
    "[bed_mesh]\nmesh_min: 0,0\nzero_reference_position: 0,0\n" + CFG + MESH: "position: 0,0",
    "[bed_mesh]\nmesh_min: 0,0\n" + CFG + MESH.replace("x_count = 5", "x_count = 6"): "x_count 6, ",
    "[bed_mesh]\nmesh_min: 0,0\n" + CFG + MESH.replace("0.1", "nan", 1): "a height 'nan",
    "[bed_mesh]\nmesh_min: 0,0\n" + CFG + MESH.replace("min_x", "min_w"): "min_x: a number",
    "[bed_mesh]\nfaulty_region_1_min: a,b\nfaulty_region_1_max: 1,2\n" + CFG + MESH: "a,b to 1,2",
    "[bed_mesh]\nmesh_min: 0,0\n" + CFG + "".join(
        mesh_lines(5, 60, name=name, round_bed=False) for name in ("a", "b")
    ): "[bed_mesh a] and [bed_mesh b]",
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG_MESHES, ids=WRONG_MESHES.values())
def test_meshes_that_cannot_be_used(text, tmp_path):
    path = files(tmp_path, printer_cfg=text)
    with pytest.raises(InputError) as caught:
        read_measured(path, read_printer(path), own=True)
    error = caught.value
    assert WRONG_MESHES[text] in f"{error.where} {error.found} {error.expected}"


# ------------------------------------------------------------------ the console


def test_samples_before_a_retry_are_dropped_and_accuracy_is_the_noise(tmp_path):
    path = files(tmp_path, printer_cfg=PROBE + CFG)
    lines = ["probe at 0.000,0.000 is z=9.000000", "probe at 0.000,0.000 is z=9.500000",
             "Probe samples exceed tolerance. Retrying..."]  # fmt: skip
    for x, y in printers.bed(8):
        lines += [f"probe at {x:.3f},{y:.3f} is z={1.25 + z:.6f}" for z in (0.1, 0.3)]
    accuracy = (
        "probe accuracy results: maximum 2.519448, minimum 2.506948, range 0.012500, average"
        " 2.513198, median 2.513198, standard deviation {}"
    )
    lines += [accuracy.format(value) for value in ("0.003000", "0.004000")]
    log = files(tmp_path, klippy_log="\n".join(lines) + "\n")
    touches, _ = read_measured(log, read_printer(path))
    tool, _ = tool_points(read_printer(path), touches)
    np.testing.assert_allclose(tool[:, 2], 1.45, atol=1e-6)
    assert touches.sigma == pytest.approx(np.sqrt((3e-3**2 + 4e-3**2) / 2))
    assert run("new", tmp_path / "kit", "--printer", path, "--probed", log).code == 0
    session = yaml.safe_load((tmp_path / "kit" / "session.yaml").read_text())
    assert session["stations"]["probe"]["tracker"]["noise"]["position"] == "0.00354 mm"


def logged(text):
    """The configuration of a printer.cfg as Klipper writes it into klippy.log."""
    lines = [line.removeprefix("#*#").strip() for line in text.splitlines()]
    rows = [line.replace(": ", " = ", 1) for line in lines if not line.startswith(("<", "DO"))]
    return "\n".join(["===== Config file =====", *rows, "======================="]) + "\n"


def test_a_log_has_the_configuration_and_what_was_probed_with_it(tmp_path):
    """Of two configurations the last one, and only the points below it."""
    old = logged(PROBE + CFG.replace("delta_radius: 105.0", "delta_radius: 100.0"))
    points = "".join(f"probe at {x:.3f},{y:.3f} is z=1.25\n" for x, y in printers.bed(8))
    text = f"Git version: 'v0.12'\n{old}{points}Stats 1.0: gcodein=0\n"
    text += f"Restarting printer\n{logged(PROBE + CFG)}Stats 2.0: gcodein=0\n"
    log = files(tmp_path, klippy_log=text)
    printer = read_printer(log)
    assert (printer.radius, printer.offset) == (105.0, (12.0, -5.5, 1.25))
    np.testing.assert_allclose(printer.homed, SAYS.homed)
    assert read_measured(log, printer, own=True) == (None, None)
    log.write_text(text + points)
    touches, _ = read_measured(log, read_printer(log), own=True)
    np.testing.assert_allclose(
        touches.carriages - 1.25, SAYS.carriages(np.pad(printers.bed(8), ((0, 0), (0, 1)))),
        atol=1e-3,
    )  # fmt: skip
    assert run("new", tmp_path / "kit", "--printer", log).code == 0


def part_marks(scale=1.0):
    """Marks (12, 2, 3) mm of Klipper's calibration object, from its pillars at 65 mm."""
    a = np.deg2rad([210, 270, 330, 30, 90, 150])
    pillars = 65 * np.column_stack([np.cos(a), np.sin(a), 0 * a])
    ends = []
    for pillar in pillars:
        u = pillar / 65
        ends.append([4.5 * u, pillar + 4.5 * u])
    for k in range(6):
        u = pillars[(k + 1) % 6] - pillars[k]
        u = u / np.linalg.norm(u)
        ends.append([pillars[k] + 4.5 * u, pillars[(k + 1) % 6] + 4.5 * u])
    return scale * np.array(ends)


def analyze(true, rng, caliper=0.02, scale=1.0, *, log=False):
    """DELTA_ANALYZE's lines of the part that a machine prints, mm; pillars 9 mm and something."""
    carriages = SAYS.carriages(part_marks(scale).reshape(-1, 3))
    there = 1e3 * true.forward(1e-3 * carriages)[:, :3, 3].reshape(12, 2, 3)
    distance = np.linalg.norm(there[:, 1] - there[:, 0], axis=1) + caliper * rng.normal(size=12)
    widths = 9 + 0.1 * rng.uniform(size=9)
    inner = [widths[n] for n in (0, 2, 1, 0, 2, 1)]  # of A, far C, B, far A, C, far B
    words = {
        "CENTER_DISTS": distance[:6] + inner,
        "OUTER_DISTS": distance[6:] + widths[3:],
        "CENTER_PILLAR_WIDTHS": widths[:3],
        "OUTER_PILLAR_WIDTHS": widths[3:],
    }
    # klippy.log has lists, a console what was typed
    form, comma = ("{} = [{}]", ", ") if log else ("{}={}", ",")
    lines = ["DELTA_ANALYZE " + form.format(name, comma.join(f"{x:.3f}" for x in values))
             for name, values in words.items()]  # fmt: skip
    return "\n".join([*lines, f"DELTA_ANALYZE SCALE={scale}"]) + "\n", distance


BUILT = printers.Settings(radius=105.6, angle=(210.3, 329.8, 90.0), rod=(270.3, 269.8, 270.1))


@pytest.mark.parametrize("scale", [1.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_a_printed_part_determines_the_size(scale, tmp_path):
    """Heights of DELTA_CALIBRATE and the twelve distances of DELTA_ANALYZE, from the files."""
    true, rng = printers.machine(BUILT, endstops=(0.5, -0.3, 0.2)), np.random.default_rng(3)
    readings = printers.felt(true, printers.bed(19), 0.015, rng)
    path = files(tmp_path, printer_cfg=printers.printer_cfg(SAYS, readings))
    text, distance = analyze(true, rng, scale=scale, log=scale != 1)
    log = files(tmp_path, klippy_log=text)
    done = run("new", tmp_path / "kit", "--printer", path, "--probed", log)
    assert done.code == 0, done.err
    rows = (tmp_path / "kit" / "distances.csv").read_text().splitlines()
    assert rows[0] == "from,to,distance [mm]"
    np.testing.assert_allclose([float(r.split(",")[2]) for r in rows[1:]], distance, atol=2e-3)
    table = read_csv(tmp_path / "kit" / "joints.csv")
    marks = part_marks(scale).reshape(-1, 3)
    np.testing.assert_allclose(1e3 * table.values[-24:], SAYS.carriages(marks), atol=1e-5)
    c = calibrate_session(tmp_path / "kit")
    assert c.verdict.usable
    assert abs(stretch(true, c.session.machine)) > 2e-3
    assert abs(stretch(true, c.machine)) < 2e-4


def test_distances_that_klipper_saved(tmp_path):
    """By steps from the end switches, for old and new values alike."""
    true = printers.machine(BUILT, endstops=(0.5, -0.3, 0.2))
    readings = printers.felt(true, printers.bed(9), 0.0, np.random.default_rng(1))
    carriages = SAYS.carriages(part_marks().reshape(-1, 3)).reshape(12, 2, 3)
    lines = []
    for k, ends in enumerate((SAYS.homed - carriages) / printers.STEP):
        lines.append(f"#*# distance{k} = {70 + k}")
        for n, steps in enumerate(ends, 1):
            lines.append(f"#*# distance{k}_pos{n} = " + ",".join(f"{s:.3f}" for s in steps))
    text = printers.printer_cfg(SAYS, readings) + "\n".join(lines) + "\n"
    printer = read_printer(files(tmp_path, printer_cfg=text))
    np.testing.assert_array_equal(printer.part.distance, 70.0 + np.arange(12))
    np.testing.assert_allclose(printer.part.carriages[printer.part.between], carriages, atol=1e-4)
    assert len(printer.touches.heights) == 9
    broken = text.replace("distance3_pos2", "distance3_pos3")
    with pytest.raises(InputError) as caught:
        read_printer(files(tmp_path, printer_cfg=broken))
    assert "distance3_pos2" in caught.value.what


@pytest.mark.parametrize(
    "text",
    [
        "DELTA_ANALYZE CENTER_DISTS=1,2,3,4,5,6\n",
        "DELTA_ANALYZE CENTER_DISTS=1,2,3\n",
        "DELTA_ANALYZE CENTER_DISTS=74,74,74,74,74,74 OUTER_DISTS=74,74,74,74,74,74"
        " CENTER_PILLAR_WIDTHS=9,9,9 OUTER_PILLAR_WIDTHS=9,9,9,9,9,80\n",
        "DELTA_ANALYZE CENTER_DISTS=74,74,74,74,74,74 OUTER_DISTS=74,74,74,74,74,74"
        " CENTER_PILLAR_WIDTHS=9,9,9 OUTER_PILLAR_WIDTHS=9,9,9,9,9,9 SCALE=0\n",
        "DELTA_ANALYZE CENTER_DISTS=74,74,74,74,74,74 OUTER_DISTS=74,74,74,74,74,74"
        " CENTER_PILLAR_WIDTHS=9,9,9 OUTER_PILLAR_WIDTHS=9,9,9,9,9,9 SCALE=90\n",
    ],
)
def test_measurements_that_are_not_complete_or_not_possible(text, tmp_path):
    printer = read_printer(files(tmp_path, printer_cfg=CFG))
    with pytest.raises(InputError):
        read_measured(files(tmp_path, console_txt=text), printer)
