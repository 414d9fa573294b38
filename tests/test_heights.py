"""Heights of a delta printer's bed: accepted and refused results."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import printers
from conftest import run
from faults import raises
from page_documents import page_document
from pkmcal.boards.board import load_board
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.machine_source import MachineSource, load_source
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.files import read_csv
from pkmcal.firmware import reprap
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.klipper import Klipper
from pkmcal.firmware.klipper_config import read_config
from pkmcal.firmware.probed import read_measured
from pkmcal.firmware.session import write_printer_session
from pkmcal.geometry.rigid import pose
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.configurations import draw_configurations
from pkmcal.session.load import load_session
from pkmcal.simulation.cylinders import to_simulate
from pkmcal.starter import untouched_files

SAYS = printers.Settings()
BUILT = printers.Settings(radius=105.6, angle=(210.3, 329.8, 90.0), rod=(270.3, 269.8, 270.1))
ENDS = (0.8, -0.5, 0.4)
NOISE = 0.015


@pytest.fixture(scope="module")
def true():
    return printers.machine(BUILT, endstops=ENDS)


@pytest.fixture(scope="module")
def kit(true, tmp_path_factory):
    """A session of nineteen points from printer.cfg, and its calibration on disk."""
    folder = tmp_path_factory.mktemp("printer")
    readings = printers.felt(true, printers.bed(19), NOISE, np.random.default_rng(1))
    (folder / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
    done = run("new", folder / "kit", "--printer", folder / "printer.cfg")
    assert done.code == 0, done.err
    assert "Next: pkmcal calibrate" in done.out
    done = run("calibrate", folder / "kit")
    assert done.code == 0, done.out + done.err
    return folder / "kit"


def flat(true, values, describe=SAYS):
    """Heights (n,) mm at other points, where a firmware with values commands Z 0."""
    rng = np.random.default_rng(9)
    r, a = 90 * np.sqrt(rng.uniform(size=200)), rng.uniform(0, 2 * np.pi, 200)
    points = np.column_stack([r * np.cos(a), r * np.sin(a), np.zeros(200)])
    readings = describe.homed - (values.homed - values.carriages(points))
    return 1e3 * true.forward(1e-3 * readings)[:, 2, 3]


def pasted(text):
    """Settings of an exported text."""
    config = read_config(text, Path("x")).entries
    rows = [config[f"stepper_{s}"] for s in "abc"]
    names = ("angle", "arm_length", "position_endstop")
    each = [tuple(float(row[name][0]) for row in rows) for name in names]
    return printers.Settings(float(config["printer"]["delta_radius"][0]), *each)


def test_the_session_states_what_the_printer_felt(kit, true):
    printer = read_printer(kit.parent / "printer.cfg")
    np.testing.assert_allclose(printer.homed, SAYS.homed, atol=1e-9)
    assert printer.touches is not None
    # the file keeps steps to a thousandth
    there = true.forward(1e-3 * printer.touches.carriages)[:, :3, 3]
    np.testing.assert_allclose(1e3 * there[:, :2], printers.bed(19), atol=1e-4)
    assert np.std(there[:, 2]) == pytest.approx(1e-3 * NOISE, rel=0.5)
    assert calibrate_session(kit).session.heights_alone


def test_it_is_accepted_for_the_bed_and_states_what_it_is_not_good_for(kit):
    saved = load(kit / "calibration")
    assert saved.verdict.usable
    bed = saved.document["bed"]
    assert bed["sigma"] < 0.02e-3 < 0.1e-3 < bed["by_drawing"]
    assert bed["size"] > 5e-4
    assert "Along x and y nothing is promised" in saved.verdict.headline
    assert saved.verdict.of("bed.sideways")
    # nineteen heights of nine values leave some over
    assert bed["touches"] == 19
    assert bed["unnoticed"] < 0.2 * bed["by_drawing"]
    page = (kit / "calibration" / "report.html").read_text(encoding="utf-8")
    assert "How flat will the bed be?" in page


def test_every_height_before_and_after(kit, true):
    """Before: the firmware's own account, its mean taken off. After: within the noise."""
    saved = load(kit / "calibration")
    heights = saved.document["heights"]
    assert [one["configuration"] for one in heights] == [f"{k:03d}" for k in range(1, 20)]
    joints = read_csv(kit / "joints.csv").values
    felt_at = load_mechanism(kit / "mechanism.yaml").forward(joints)[:, 2, 3]
    before, after, sigma, x, y = (
        np.array([one[key] for one in heights]) for key in ("before", "after", "sigma", "x", "y")
    )
    np.testing.assert_allclose(before, felt_at - felt_at.mean(), atol=1e-9)
    assert np.std(before) > 1e-4
    # the probe's default, with a share of the carriages' steps
    assert np.all((sigma > 20e-6) & (sigma < 21e-6))
    assert 0.3 * NOISE < 1e3 * np.sqrt(np.mean(after**2)) < NOISE
    np.testing.assert_allclose(1e3 * np.column_stack([x, y]), printers.bed(19), atol=1.0)
    page = page_document((kit / "calibration" / "report.html").read_text(encoding="utf-8"))
    (part,) = (one for one in page["sections"] if one["name"] == "heights")
    (table,) = (block for block in part["blocks"] if block["kind"] == "table")
    names = [row["cells"][0] for row in table["rows"]]
    order = np.argsort(-np.abs(after / sigma))
    assert names == [heights[k]["configuration"] for k in order]
    assert [row["cells"][-1] for row in table["rows"]] == ["worst"] + 18 * ["used"]
    (maps,) = (block["plots"] for block in part["blocks"] if block["kind"] == "panels")
    for each, errors in zip(maps, (before, after), strict=True):
        points = each["marks"][0]["points"]
        np.testing.assert_allclose([p["value"] for p in points], 1e3 * errors, atol=1e-3)
    assert maps[0]["colours"]["limits"] == maps[1]["colours"]["limits"]
    text = run("calibrate", kit, "-o", kit.parent / "again").out
    assert f"{names[0]} at x" in text


def test_the_origin_of_the_noise_is_stated(kit, tmp_path):
    session = load_session(kit)
    assert session.trackers[0].position == 20e-6
    (finding,) = (one for one in session.findings if one.code == "session.default_noise")
    assert finding.facts["sigma"] == 20e-6
    assert "PROBE_ACCURACY" in finding.text
    assert not session.warnings
    for path in kit.glob("*.*"):
        (tmp_path / path.name).write_text(path.read_text())
    text = (tmp_path / "session.yaml").read_text()
    (tmp_path / "session.yaml").write_text(
        text.replace("# noise: {position: 0.02", "noise: {position: 0.015")
    )
    stated = load_session(tmp_path)
    assert stated.trackers[0].position == 15e-6
    assert not stated.findings


def test_what_is_pasted_puts_z_0_on_the_bed(kit, true):
    """The bed at other points is flat, without tilt and height, within the noise."""
    made = make_export(load_source(kit / "calibration"), "klipper")
    (text,) = made.files.values()
    before, after = flat(true, SAYS), flat(true, pasted(text))
    assert np.sqrt(np.mean(before**2)) > 0.3
    # three numbers of a plane from nineteen points, and what bends: of the noise no more than half
    assert np.sqrt(np.mean(after**2)) < NOISE
    sigma = 1e3 * load(kit / "calibration").document["bed"]["sigma"]
    assert np.std(after) < 2.2 * sigma
    assert any("Measure the bed's mesh anew" in note.text for note in made.notes)
    assert any("Z is 0 on the bed" in note.text for note in made.notes)
    (lines,) = make_export(load_source(kit / "calibration"), "reprap").files.values()
    assert re.search(r"^M665 L[\d.:]+ R105\.", lines, re.MULTILINE)


def test_a_level_bed_stays_level(kit):
    calibration = calibrate_session(kit)
    up = calibration.estimate.state.T_camera_base[0, :3, 2]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    text = (kit / "session.yaml").read_text()
    other = kit.parent / "tilted"
    other.mkdir()
    for name in ("mechanism.yaml", "joints.csv", "poses.csv"):
        (other / name).write_text((kit / name).read_text())
    (other / "session.yaml").write_text(text.replace("level: true", "level: false"))
    free = calibrate_session(other)
    # end switches off by a millimetre on a circle of 105 mm
    assert np.linalg.norm(free.estimate.state.T_camera_base[0, :2, 2]) > 2e-3


def test_deviations_of_the_bed_hold(tmp_path):
    """Ten printers: flatness over its deviation, and sizes over theirs."""
    rng = np.random.default_rng(5)
    bend, size = [], []
    for run_ in range(10):
        off = replace(
            SAYS,
            radius=105 + rng.normal(),
            angle=tuple(np.array(SAYS.angle) + np.rad2deg(rng.normal(size=3) / 105)),
            rod=tuple(270 + 0.5 * rng.normal(size=3)),
        )
        true = printers.machine(off, endstops=tuple(rng.normal(size=3)))
        readings = printers.felt(true, printers.bed(13), 0.02, rng)
        (tmp_path / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
        write_printer_session(tmp_path / str(run_), tmp_path / "printer.cfg")
        calibration = calibrate_session(tmp_path / str(run_))
        bed = calibration.identification.bed
        (text,) = Klipper().files(MachineSource(calibration.machine, bed=bed.z)).values()
        z = 1e-3 * flat(true, pasted(text))
        bend.append(np.std(z) / bed.sigma)
        xy = printers.bed(30)
        T = pose(np.eye(3), 1e-3 * np.column_stack([xy, np.zeros(30)]))
        there = true.forward(calibration.machine.inverse(T))[:, :2, 3]
        plane = np.column_stack([1e-3 * xy, np.ones(30)])
        slope = np.linalg.lstsq(plane, there, rcond=None)[0]
        size.append((np.trace(slope[:2]) / 2 - 1) / bed.size)
    # 10 values of about one degree of freedom each: 4 of their deviations
    assert np.mean(np.square(bend)) == pytest.approx(1, abs=4 * np.sqrt(2 / 10))
    assert np.mean(np.square(size)) == pytest.approx(1, abs=4 * np.sqrt(2 / 10))


def test_a_crumb_under_the_nozzle_does_not_bend_the_bed(true, tmp_path):
    """One touch of nineteen, 0.3 mm too high, is rejected, and the bed is as flat as without it."""
    readings = printers.felt(true, printers.bed(19), NOISE, np.random.default_rng(1))
    readings[9] += 0.3
    (tmp_path / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
    write_printer_session(tmp_path / "kit", tmp_path / "printer.cfg")
    calibration = calibrate_session(tmp_path / "kit")
    assert np.flatnonzero(calibration.estimate.pose_weights < 0.5).tolist() == [9]
    bed = calibration.identification.bed
    (text,) = Klipper().files(MachineSource(calibration.machine, bed=bed.z)).values()
    assert np.std(flat(true, pasted(text))) < 2.2e3 * bed.sigma
    assert calibration.verdict.usable


def test_heights_that_are_no_gain_are_refused(true, tmp_path):
    """Seven points within a centimetre in one corner do not determine the bed's edge."""
    places = np.array([60.0, 0.0]) + printers.bed(7, 8.0)
    readings = printers.felt(true, places, NOISE, np.random.default_rng(2))
    cfg = printers.printer_cfg(SAYS, readings)
    (tmp_path / "printer.cfg").write_text(cfg)
    write_printer_session(tmp_path / "kit", tmp_path / "printer.cfg")
    done = run("calibrate", tmp_path / "kit", "--json")
    assert done.code == 1
    (reason,) = done.json["verdict"]["reasons"]
    assert "that is no gain" in reason
    assert "Probe more points" in reason
    refused = run("export", tmp_path / "kit" / "calibration", "--to", "klipper")
    assert refused.code == 1


# ------------------------------------------------------------------ rejected heights

SMALL = printers.Settings(radius=118.0, rod=(240.0,) * 3, endstop=(260.0,) * 3)


def session_of(folder, off, n, *, wrong=(), bed=None, noise=0.008):
    """Session of n heights of a printer whose radius is ``off`` mm larger than its firmware's
    value.

    wrong : (which, mm) heights that are too high. bed : mm, heights (n,) at places (n, 2).
    """
    true = printers.machine(replace(SMALL, radius=SMALL.radius + off))
    places = printers.bed(n, 75.0)
    readings = printers.felt(true, places, noise, np.random.default_rng(0))
    for which, height in wrong:
        readings[which] += height
    if bed is not None:
        readings += bed(places)[:, None]
    folder.mkdir(exist_ok=True)
    (folder / "printer.cfg").write_text(printers.printer_cfg(SMALL, readings))
    write_printer_session(folder / "kit", folder / "printer.cfg")
    return folder / "kit"


def with_tolerance(kit, centre):
    """Set another tolerance of the towers, mm."""
    text = (kit / "mechanism.yaml").read_text()
    other = re.sub(r"center: \S+ mm, offset", f"center: {centre} mm, offset", text)
    assert other != text
    (kit / "mechanism.yaml").write_text(other)


BOWL = """\
configuration,x [mm],y [mm],z [mm]
p00,0.000,0.000,0.0003
p01,73.505,14.900,-0.4719
p02,23.849,71.107,-0.4684
p03,-49.656,56.207,-0.4869
p04,-73.505,-14.900,-0.4806
p05,-23.849,-71.107,-0.4870
p06,49.656,-56.207,-0.4737
"""
"""Heights of such a printer whose radius is 116.1 mm; least squares give 116.11 mm."""


@pytest.mark.parametrize("centre", [None, 3.0])
def test_what_one_parameter_explains_is_not_rejected(tmp_path, centre):
    """Seven heights, the radius 1.9 mm wrong: where the ring fits, the centre is 26 standard
    deviations off, and with the radius all fit.
    """
    text_file(tmp_path, printers.printer_cfg(SMALL), "printer.cfg")
    write_printer_session(
        tmp_path / "kit", tmp_path / "printer.cfg", text_file(tmp_path, BOWL, "probed.csv")
    )
    if centre:
        with_tolerance(tmp_path / "kit", centre)
    assert run("calibrate", tmp_path / "kit").code == 0
    saved = load(tmp_path / "kit" / "calibration")
    assert saved.document["rejected"] == []
    (text,) = make_export(load_source(tmp_path / "kit" / "calibration"), "klipper").files.values()
    assert pasted(text).radius == pytest.approx(116.1, abs=0.05)
    # one of each height, less the bed's own: all else is known beforehand
    assert saved.document["statistics"]["dof"] == 6


def test_a_rejection_that_nothing_confirms_is_refused_and_named(tmp_path):
    """Two millimetres under the probe: among seven heights any one may be the wrong one; among
    nineteen it is this one for sure.
    """
    for n, usable in ((7, False), (19, True)):
        kit = session_of(tmp_path / str(n), 0.3, n, wrong=[(3, 2.0)])
        calibration = calibrate_session(kit)
        assert np.flatnonzero(calibration.estimate.pose_weights < 0.5).tolist() == [3]
        assert calibration.verdict.usable == usable
        (named,) = calibration.verdict.of("rejected.units")
        assert (named.facts["of"], named.facts["names"]) == (f"{n} heights", ["004"])
        unconfirmed = calibration.verdict.of("rejected.unconfirmed")
        assert len(unconfirmed) == (not usable)
        assert all("004" in one.subject for one in unconfirmed)
    done = run("calibrate", tmp_path / "7" / "kit")
    assert done.code == 1
    assert "6 of 7 heights" in done.out
    assert run("export", tmp_path / "7" / "kit" / "calibration", "--to", "klipper").code == 1


def test_an_uneven_bed_is_no_population_of_outliers(tmp_path):
    """A bed that waves by a tenth of a millimetre: its heights stay, their noise is enlarged, and
    where it is enlarged too far the result is refused.
    """
    kit = session_of(
        tmp_path,
        -1.0,
        49,
        bed=lambda xy: 0.1 * np.sin(xy[:, 0] / 20) * np.cos(xy[:, 1] / 17),
    )
    calibration = calibrate_session(kit)
    assert np.mean(calibration.estimate.pose_weights < 0.5) < 0.05
    assert calibration.estimate.statistics.pose_scale > 2
    bent = np.std(flat_of_small(-1.0, calibration))
    assert not calibration.verdict.usable or bent < 3e3 * calibration.identification.bed.sigma


def flat_of_small(off, value):
    """Heights (n,) mm over the bed of such a printer with the exported values of a result."""
    true = printers.machine(replace(SMALL, radius=SMALL.radius + off))
    (text,) = Klipper().files(MachineSource(value.machine, bed=value.identification.bed.z)).values()
    points = np.column_stack([printers.bed(60, 75.0), np.zeros(60)])
    values = pasted(text)
    readings = SMALL.homed - (values.homed - values.carriages(points))
    return 1e3 * true.forward(1e-3 * readings)[:, 2, 3]


def test_so_few_that_a_wrong_one_would_not_show_say_so(tmp_path):
    """A crumb under one of seven touches bends the bed more than the nominal model did, and no
    residual shows it; of thirteen it is rejected.
    """
    true = printers.machine(BUILT, endstops=ENDS)
    bent: dict[int, float] = {}
    for n in (7, 13):
        readings = printers.felt(true, printers.bed(n), NOISE, np.random.default_rng(3))
        readings[n // 2] += 0.3
        (tmp_path / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
        write_printer_session(tmp_path / str(n), tmp_path / "printer.cfg")
        calibration = calibrate_session(tmp_path / str(n))
        (text,) = (
            Klipper()
            .files(MachineSource(calibration.machine, bed=calibration.identification.bed.z))
            .values()
        )
        bent[n] = float(np.std(flat(true, pasted(text))))
        assert calibration.verdict.usable
        assert (calibration.estimate.pose_weights < 0.5).sum() == (n == 13)
        warned = calibration.verdict.of("bed.height_unnoticed")
        assert len(warned) == (n == 7)
        if n == 7:
            assert (warned[0].facts["touches"], warned[0].facts["more"]) == (7, 8)
    assert bent[7] > 2 * bent[13]


# ------------------------------------------------------------------ output of printers


def text_file(folder, text, name="console.txt"):
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture
def cfg(tmp_path):
    """A printer.cfg without heights, whose probe is aside of the nozzle."""
    text = "[probe]\nx_offset: 12\ny_offset: -5.5\nz_offset: 1.25\n" + printers.printer_cfg(SAYS)
    return text_file(tmp_path, text, "printer.cfg")


PLACES = printers.bed(8)
Z = np.linspace(-0.3, 0.4, 8)


def test_points_of_klippers_console(cfg):
    """Both of its sentences give the same points; several touches of one place count by
    their mean.
    """
    printer, folder = read_printer(cfg), cfg.parent
    old = [f"// probe at {x:.3f},{y:.3f} is z={z + 1.25 + d:.6f}"
           for (x, y), z in zip(PLACES, Z, strict=True) for d in (-0.01, 0.01)]  # fmt: skip
    new = [f"// probe: at {x + 12:.3f},{y - 5.5:.3f} bed will contact at z={z:.6f}"
           for (x, y), z in zip(PLACES, Z, strict=True)]  # fmt: skip
    want = SAYS.carriages(np.column_stack([PLACES, Z]))
    one = read_measured(text_file(folder, "Send: PROBE\n" + "\n".join(old)), printer)[0]
    other = read_measured(text_file(folder, "\n".join(new)), printer)[0]
    np.testing.assert_allclose(one.carriages - 1.25, want, atol=1e-3)
    np.testing.assert_allclose(one.heights, 1.25)
    np.testing.assert_allclose(other.carriages, want, atol=1e-3)
    np.testing.assert_allclose(other.heights, 0.0)


END_A = "#*# position_endstop = 300.0\n"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (END_A, "position_endstop = 299.1\n", "position_endstop = 299.1"),
        (END_A, "#*#position_endstop = 299.1\n", "#*#position_endstop = 299.1"),
        ("#*#\n#*# [stepper_b]", "\n#*# [stepper_b]", ""),
        ("#*# <--", "# <--", "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto"),
    ],
)
def test_saved_lines_that_klipper_would_drop_are_reported(tmp_path, old, new, line):
    text = printers.printer_cfg(SAYS)
    spoilt = text.replace(old, new, 1)
    assert spoilt != text
    # for a missing header the following line is reported
    above = spoilt[: spoilt.index(new)].count("\n") + new.startswith("# <")
    where = f"printer.cfg, line {above + 1}"
    with raises(InputError, code="printer.saved_lines_dropped", where=where) as error:
        read_printer(text_file(tmp_path, spoilt, "printer.cfg"))
    assert error.value.found.strip("'…") == line
    assert ("header back" in error.value.next_step) == new.startswith("# <")


def test_a_board_on_a_printer(cfg):
    """The session is a delta's: its motors, millimetres and steps, and a board that has room."""
    folder = cfg.parent / "kit"
    done = run("new", folder, "--printer", cfg, "--board", "--places", "2")
    assert done.code == 0, done.err
    texts = {p.name: p.read_text() for p in folder.rglob("*") if p.is_file()}
    words = " ".join(texts.values())
    assert not re.search(r"\bleg(s|1)\b", words.replace("legs[*]", "").replace("legs:", ""))
    session = load_session(folder, measured=False)
    assert session.joint_noise == pytest.approx(1e-3 * printers.STEP / np.sqrt(12), rel=0.15)
    assert texts["joints.csv"].startswith(
        "configuration,stepper_a [mm],stepper_b [mm],stepper_c [mm]"
    )
    there = session.machine.forward(read_csv(folder / "joints.csv").values)[:, :3, 3]
    np.testing.assert_allclose(there[0], session.machine.home()[:3, 3], atol=1e-6)
    # from a place half way out, its corners stay where the tool itself may go
    corners = load_board(session.board).points
    across = np.linalg.norm(np.ptp(corners, axis=0))
    assert 0.5 * 0.09 < across < 0.09
    untouched = " ".join(one.text for one in untouched_files(folder))
    assert "joints.csv is still the example" in untouched
    assert "board.yaml is still the example" in untouched


def test_the_nominal_model_of_a_printer_is_simulated(cfg):
    """Its rods meet in one point, all that a firmware has of the platform."""
    run("new", cfg.parent / "kit", "--printer", cfg, "--board")
    nominal = load_mechanism(cfg.parent / "kit" / "mechanism.yaml")
    poses, joints = draw_configurations(
        to_simulate(nominal, "x"), 30, 0.3, np.random.default_rng(0)
    )
    assert len(poses) >= 30
    np.testing.assert_allclose(nominal.forward(joints), poses, atol=1e-9)


REPRAP = """\
M669 K3
M665 L270.0 R105.0 H300.0 B90.0 X0.2 Y-0.1 Z0.3 ; delta
M666 X0.5 Y-0.3 Z-0.2 A0.1 B-0.2
"""


def reprap_settings():
    return printers.Settings(105.0, (210.2, 329.9, 90.3), (270.0,) * 3, (300.5, 299.7, 299.8))


def test_points_of_reprapfirmware(tmp_path):
    printer = read_printer(text_file(tmp_path, REPRAP, "config.g"))
    settings = reprap_settings()
    np.testing.assert_allclose(printer.homed, settings.homed, atol=1e-9)
    tilt = (0.1 * PLACES[:, 0] - 0.2 * PLACES[:, 1]) / 100
    want = settings.carriages(np.column_stack([PLACES, Z])) + tilt[:, None]
    lines = [f"G30 P{k} X{x:.3f} Y{y:.3f} Z-99999" for k, (x, y) in enumerate(PLACES)]
    lines[-1] += " S-1"
    heights = " ".join(f"{z:.3f}" for z in Z)
    text = "\n".join([*lines, f"G32 bed probe heights: {heights}, mean 0.05, deviation 0.2"])
    values = read_measured(text_file(tmp_path, text), printer)[0]
    np.testing.assert_allclose(values.carriages, want, atol=2e-3)


def test_points_of_a_height_map(tmp_path):
    """Rows go along y, a plain 0 was not probed, a height of 0.000 was."""
    printer = read_printer(text_file(tmp_path, REPRAP.replace(" A0.1 B-0.2", ""), "config.g"))
    text = (
        "RepRapFirmware height map file v2 generated at 2026-11-23 10:00, min error -0.1\n"
        "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1\n"
        "X,Y,-40.00,40.00,-30.00,30.00,50.00,40.00,30.00,3,3\n"
        "      0,  0.010,      0\n  0.020,  0.000, -0.030\n  0.040,  0.050,      0\n"
    )
    results = read_measured(text_file(tmp_path, text, "heightmap.csv"), printer)[0]
    points = [(0, -30, 0.01), (-40, 0, 0.02), (0, 0, 0), (40, 0, -0.03), (-40, 30, 0.04),
              (0, 30, 0.05)]  # fmt: skip
    want = reprap_settings().carriages(np.array(points, dtype=float))
    np.testing.assert_allclose(results.carriages, want, atol=1e-9)
    old = text.replace("axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1",
                       "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum")  # fmt: skip
    old = old.replace("X,Y,-40", "-40")
    same = read_measured(text_file(tmp_path, old, "heightmap.csv"), printer)[0]
    np.testing.assert_allclose(same.carriages, want, atol=1e-9)
    # of the first versions, with one spacing
    first = old.replace("xspacing,yspacing", "spacing").replace("40.00,30.00,3,3", "40.00,3,3")
    same = read_measured(text_file(tmp_path, first, "heightmap.csv"), printer)[0]
    points = [(x, -30 + (y + 30) * 40 / 30, z) for x, y, z in points]
    want = reprap_settings().carriages(np.array(points))
    np.testing.assert_allclose(same.carriages, want, atol=1e-9)


def test_a_printer_without_a_print_radius(tmp_path):
    """M665 without B leaves the print radius as it was; exports write none."""
    with_radius = read_printer(text_file(tmp_path, REPRAP, "config.g"))
    text = re.sub(r" B[0-9.]+", "", REPRAP, count=1)
    printer = read_printer(text_file(tmp_path, text, "config.g"))
    assert with_radius.reach is not None
    assert printer.reach is None
    np.testing.assert_array_equal(printer.homed, with_radius.homed)


def test_a_table_of_points(cfg):
    rows = "\n".join(f"{k},{x:.4f},{y:.4f},{0.002 * x:.4f}" for k, (x, y) in enumerate(PLACES))
    path = text_file(cfg.parent, "configuration,x [mm],y [mm],z [mm]\n" + rows, "points.csv")
    done = run("new", cfg.parent / "kit", "--printer", cfg, "--probed", path, "--json")
    assert done.code == 0, done.err
    assert sorted(done.json["files"]) == [
        "joints.csv", "mechanism.yaml", "poses.csv", "session.yaml",
    ]  # fmt: skip
    assert run("check", cfg.parent / "kit").code == 0


def test_a_step_is_what_the_motor_makes_of_it(true, tmp_path):
    """Gears, full steps and microsteps; a tower without its own has the first's."""
    readings = printers.felt(true, printers.bed(7), 0.0, np.random.default_rng(0))
    text = printers.printer_cfg(SAYS, readings)
    geared = text.replace("rotation_distance: 40", "rotation_distance: 160\ngear_ratio: 80:20")
    fine = text.replace("microsteps: 16", "microsteps: 8\nfull_steps_per_rotation: 400")
    head, tail = text.split("[stepper_b]", 1)
    first = head + "[stepper_b]" + tail.replace("microsteps: 16\nrotation_distance: 40\n", "")
    for kind in (text, geared, fine, first):
        printer = read_printer(text_file(tmp_path, kind, "printer.cfg"))
        np.testing.assert_allclose(printer.touches.carriages, readings, atol=1e-5)


def test_a_reprapfirmware_printer_from_its_height_map(true, tmp_path):
    """config.g and heightmap.csv to M665 and M666, which put Z 0 on the bed; no file of ours is
    read in between."""
    config = text_file(tmp_path, "M665 L270 R105 H300 B90\nM666 X0 Y0 Z0\n", "config.g")
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-60, 60, 5), np.linspace(-60, 60, 5)))
    z = np.zeros(25)
    for _ in range(8):  # lowered until it touches
        readings = SAYS.carriages(np.column_stack([x, y, z]))
        z = z - 1e3 * true.forward(1e-3 * readings)[:, 2, 3]
    z = z + NOISE * np.random.default_rng(3).normal(size=25)
    rows = "".join(", ".join(f"{h:.3f}" for h in row) + "\n" for row in z.reshape(5, 5))
    text = (
        "RepRapFirmware height map file v2 generated at 2026-11-23 10:00, min error -0.9\n"
        "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1\n"
        f"X,Y,-60.00,60.00,-60.00,60.00,90.00,30.00,30.00,5,5\n{rows}"
    )
    probed = text_file(tmp_path, text, "heightmap.csv")
    done = run("new", tmp_path / "kit", "--printer", config, "--probed", probed)
    assert done.code == 0, done.err
    assert "--to reprap" in (tmp_path / "kit" / "session.yaml").read_text()
    for words in (("calibrate", "kit"), ("export", "kit/calibration", "--to", "reprap")):
        done = run(words[0], tmp_path / words[1], *words[2:])
        assert done.code == 0, done.out + done.err
    (path,) = (tmp_path / "kit" / "export-reprap").iterdir()
    words = reprap.read_words(path.read_text())
    assert words["665B"].tolist() == [90.0]  # the printer's own
    values = np.column_stack([0.7 * x + 3, 0.8 * y - 2, 0 * x])
    travel = reprap.homed_carriages(words) - reprap.reprap_carriage_heights(words, values)
    there = 1e3 * true.forward(1e-3 * (SAYS.homed - travel))[:, 2, 3]
    assert np.abs(z).max() > 0.3
    assert np.sqrt(np.mean(there**2)) < NOISE


def test_heights_predict_no_readings(kit):
    """Of a pose of which only the height was measured, the rest follows from its readings; this is
    reported before any work.
    """
    done = run("calibrate", kit, "-o", kit.parent / "held", "--holdout", "5", "--json")
    assert (done.code, done.json["found"]) == (2, "heights alone")
    steps: list[str] = []
    with pytest.raises(InputError):
        calibrate_session(kit, holdout=5, progress=lambda step, _share: steps.append(step))
    assert steps == []


def test_a_board_on_a_printers_tool(cfg):
    """The nominal model is the printer's; all parameters that a board determines are free."""
    done = run("new", cfg.parent / "kit", "--printer", cfg, "--board")
    assert done.code == 0, done.err
    text = (cfg.parent / "kit" / "mechanism.yaml").read_text()
    assert "constant: 270 mm" in text
    assert "base.axis" not in text.partition("fixed:")[2]
    assert (cfg.parent / "kit" / "board.yaml").is_file()
    assert "What is still missing" in done.out


# ------------------------------------------------------------------ what cannot be read


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


CFG = printers.printer_cfg(SAYS, np.tile(SAYS.homed - 200, (7, 1)))
WRONG_PRINTERS = {
    "G28\nG29\n": "nothing in this file shows which firmware",
    changed(CFG, "kinematics: delta", "kinematics: corexy"): "heights of a bed are read of linear",
    changed(CFG, "delta_radius: 105.0", ""): "this value of the printer is missing: delta_radius",
    changed(CFG, "arm_length: 270.0", "arm_length: long"): "arm_length is no number",
    changed(CFG, "delta_radius: 105.0", "delta_radius: 300"): "longer than the delta radius",
    changed(CFG, "angle: 330.0", "angle: 220"): "two towers are less than 60 degrees apart",
    changed(CFG, "height0_pos = ", "height0_pos = 1e8,1e8,1e8 #"): "far below the bed",
    changed(CFG, "microsteps: 16", "microsteps: 16\ngear_ratio: 3"): "the gears cannot be read",
    changed(CFG, "height0_pos = ", "height0_pos = x"): "height0_pos does not give",
    "M584 X0\nM665 L270 R1.0.5 H300 B90\n": "a value of this line is no number that a printer",
    "M584 X0\nM665 R105 H300 B90\n": "M665 has no value L that could be used",
    printers.printer_cfg(
        SAYS, np.tile(SAYS.homed + 2, (7, 1))
    ): "stepper_a 2 mm above its end switch",
    printers.printer_cfg(SAYS): "there is no probed point of the bed",
    printers.printer_cfg(SAYS, np.tile(SAYS.homed - 200, (6, 1))): "too few points of the bed",
}


@pytest.mark.parametrize("text", WRONG_PRINTERS, ids=WRONG_PRINTERS.values())
def test_a_printers_file_with_too_little_in_it(text, tmp_path):
    path = text_file(tmp_path, text, "printer.cfg")
    done = run("new", tmp_path / "kit", "--printer", path)
    assert done.code == 2
    assert WRONG_PRINTERS[text] in " ".join(done.err.split())
    assert not (tmp_path / "kit").exists()


@pytest.mark.parametrize(
    ("angles", "apart"),
    [
        ((0.0, 90.0, 170.0), True),  # all on one side of the bed
        ((210.0, 250.0, 330.0), False),
        ((0.0, 10.0, 185.0), False),
        ((350.0, 10.0, 185.0), False),
    ],
)
def test_towers_of_a_printer_are_apart(angles, apart, tmp_path):
    """A delta is singular where two of its towers coincide."""
    text = printers.printer_cfg(replace(SAYS, angle=angles), np.tile(SAYS.homed - 200, (7, 1)))
    path = text_file(tmp_path, text, "printer.cfg")
    if apart:
        np.testing.assert_array_equal(read_printer(path).angle, angles)
        return
    with raises(InputError, found=", ".join(f"{a:g}" for a in angles) + " degrees"):
        read_printer(path)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1e9", "0:1"])
@pytest.mark.parametrize("name", [
    "rotation_distance: 40", "microsteps: 16", "arm_length: 270.0", "delta_radius: 105.0",
    "print_radius: 90", "full_steps_per_rotation: 200", "gear_ratio: 1:1", "gear_ratio: 2:1, 1:2",
])  # fmt: skip
def test_what_no_printer_has_is_refused_with_its_line(name, value, tmp_path):
    """Values of the first tower, for all."""
    key, _, right = name.partition(": ")
    lines = [line for line in CFG.splitlines() if not line.startswith(key)]
    section = "[printer]" if key in ("delta_radius", "print_radius") else "[stepper_a]"
    at = lines.index(section) + 1
    spoilt = [*lines[:at], f"{key}: {right.replace('1', value, 1) if ':' in right else value}"]
    path = text_file(tmp_path, "\n".join([*spoilt, *lines[at:]]), "printer.cfg")
    done = run("new", tmp_path / "kit", "--printer", path)
    assert done.code == 2
    assert f"printer.cfg, line {at + 1}, {section}" in " ".join(done.err.split())
    assert "Warning" not in done.err


@pytest.mark.parametrize("value", ["0", "-1", "nan", "9999999"])
@pytest.mark.parametrize("letter", ["L", "R", "H", "B"])
def test_what_no_reprapfirmware_printer_has_is_refused_with_its_line(letter, value, tmp_path):
    words = {"L": "270", "R": "105", "H": "300", "B": "90", letter: value}
    text = "G28\nM665 " + " ".join(f"{k}{v}" for k, v in words.items()) + "\n"
    done = run(
        "new", tmp_path / "kit", "--printer", text_file(tmp_path, text, "config.g"), "--board"
    )
    assert done.code == 2
    assert letter in done.err


MAP = "RepRapFirmware height map file v2\nxmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum\n"


@pytest.mark.parametrize("override", [False, True])
def test_the_tool_is_beside_the_probe_of_reprapfirmware(override, tmp_path):
    """Places of a map and of G30 are those under the probe, by G31 at the nozzle plus X and Y."""
    config = "M665 L270:270:270 R105 H300\nM666 X0 Y0 Z0\nG31 P500 X20 Y-5 Z2.5 ; X1\n"
    (tmp_path / "config-override.g").write_text("G31 K0 P500 X-12.0\n" if override else "")
    path = text_file(tmp_path, config + "M501\n", "config.g")
    places = [(0, 0), (60, 0), (-60, 0), (0, 60), (0, -60), (40, 40), (-40, -40)]
    log = "".join(f"G30 P{k} X{x} Y{y} Z-99999\n" for k, (x, y) in enumerate(places))
    log += "G32 bed probe heights:" + 7 * " 0.100" + ", mean 0.1\n"
    printer = read_printer(path)
    tool = np.array([(x - (-12 if override else 20), y + 5, 0.1) for x, y in places])
    touches, _ = read_measured(text_file(tmp_path, log), printer)
    np.testing.assert_allclose(touches.carriages, printer.carriages(tool), atol=1e-9)
    path.write_text(config.replace("X20", "X{global.dx}"))
    with pytest.raises(InputError) as caught:
        read_measured(text_file(tmp_path, log), read_printer(path))
    assert caught.value.where == "config.g"


WRONG_POINTS = {
    "ok\n": "there is no point of a bed in this file",
    "probe at 300.000,0.000 is z=0.1\n": "the printer does not reach this point",
    MAP.replace("xmin,xmax", "axis0,axis1,min0,max0") + "X,Z,-1,1\n0.1\n": "not of the axes",
    MAP + "-10,10\n0.1\n": "the height map does not define its grid",
    MAP + "-10,10,-10,10,-1,0,10,3,3\n0.1,0.2,0.2\n": "a number above zero under xspacing",
    MAP + "-10,10,nan,10,-1,10,10,3,3\n0.1,0.2,0.2\n": "a number under ymin",
    MAP + "-10,10,-10,10,-1,10,10,3,1\n0.1,high,0.2\n": "row 1 of heights: a height is no number",
    MAP + "-10,10,-10,10,-1,10,10,3,1\n0.1,nan,0.2\n": "found 'nan', expected millimetres",
    MAP + "-10,10,-10,10,-1,10,10,3,3\n0.1,0.1,0.2\n": "found 1 rows, expected 3 rows of 3",
    MAP + "-10,10,-10,10,-1,10,10,3,1\n0.1,0.1\n": "row 1 of heights: the height map is not com",
    "G30 P0 X0 Y0 Z-99999\nG32 bed probe heights: 0.1 0.2, mean 0.1\n": "do not belong together",
}


@pytest.mark.parametrize("text", WRONG_POINTS, ids=WRONG_POINTS.values())
def test_points_that_cannot_be_read(text, cfg):
    path = text_file(cfg.parent, text)
    done = run("new", cfg.parent / "kit", "--printer", cfg, "--probed", path)
    assert done.code == 2
    assert WRONG_POINTS[text] in " ".join(done.err.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--probed", "x"), "--printer FILE"),
        (("--printer", "x"), "the file does not exist"),
        (("--printer", "x", "--machine", "delta"), "--machine besides"),
        (("--printer", "x", "--board", "--probed", "y"), "--probed besides"),
    ],
)
def test_options_that_do_not_go_together(words, message, tmp_path):
    done = run("new", tmp_path / "kit", *words)
    assert done.code == 2
    assert message in " ".join(done.err.split())


def test_only_a_bed_is_level(kit, tmp_path):
    folder = tmp_path / "kit"
    folder.mkdir()
    for name in ("mechanism.yaml", "joints.csv", "session.yaml"):
        (folder / name).write_text((kit / name).read_text())
    rows = "".join(f"{k + 1:03d},0,0,0\n" for k in range(19))
    (folder / "poses.csv").write_text("configuration,x,y,z\n" + rows)
    with raises(InputError, found="columns x, y, z", expected="configuration and z"):
        calibrate_session(folder)


def test_the_document_of_calibrate(kit):
    document = json.loads((kit / "calibration" / "calibration.json").read_text())
    assert document["bed"].keys() == {
        "radius", "sigma", "by_drawing", "sideways", "size", "z", "touches", "unnoticed",
    }  # fmt: skip
    assert document["station_covariance"]["stations"] == []


def test_of_a_value_above_and_in_saved_lines_klipper_takes_the_one_above():
    """As its own reader does; who pastes above and leaves SAVE_CONFIG's lines has the new value."""
    text = printers.calibrated_cfg()
    changed = text.replace("[stepper_a]\n", "[stepper_a]\nposition_endstop: 299.5\n", 1)
    before, after = (Klipper().printer(t, Path("printer.cfg")) for t in (text, changed))
    assert before.homed[0] - after.homed[0] == pytest.approx(0.5)
    np.testing.assert_array_equal(before.homed[1:], after.homed[1:])
