"""The exported C source, compiled without a warning and held against our own kinematics."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from conftest import run
from export_sources import built, calibration, source_of
from faults import raises
from pkmcal.calibration.machine_source import load_source
from pkmcal.errors import InputError
from pkmcal.exporters.c import C_SOURCE_FOLDER, MACHINE_NUMBERS_END, CSource
from pkmcal.exporters.contract import exporters, make_export
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import catalogue, load_mechanism
from screw_hexapod import screw_hexapod

COMPILER = shutil.which("gcc") or shutil.which("cc")
CPP_COMPILER = shutil.which("g++") or shutil.which("c++")
AVR_COMPILER, ARM_COMPILER = shutil.which("avr-gcc"), shutil.which("arm-none-eabi-gcc")
WARNINGS = ["-Wall", "-Wextra", "-pedantic-errors", "-Wconversion", "-Wfloat-conversion", "-Werror"]
FLAGS = ["-std=c99", "-O1", *WARNINGS, "-shared", "-fPIC"]
REALS = {"double": ctypes.c_double, "float": ctypes.c_float}
EPSILON = {"double": np.finfo(np.float64).eps, "float": np.finfo(np.float32).eps}
SOURCES = ("pkmcal_kinematics.c", "pkmcal_selftest.c")
SCREWS = "screw-hexapod"
OK, NOT_CONVERGED, SINGULAR, OUT_OF_REACH, BAD_INPUT = range(5)
needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason="NO C COMPILER (gcc or cc): the exported C source is not tested"
)


def structures(real):
    """The header's pose and report, of one type of numbers."""
    pose = type("Pose", (ctypes.Structure,), {"_fields_": [("R", real * 9), ("t", real * 3)]})
    fields = [("steps", ctypes.c_int), ("error", real), ("pivot", real)]
    return pose, type("Report", (ctypes.Structure,), {"_fields_": fields})


def compiled(machine, folder, *flags, real="double"):
    """A machine's source as a library, its functions on NumPy arrays."""
    for name, text in exporters()["c"].files(source_of(machine)).items():
        (folder / name).write_text(text)
    sources = [str(folder / name) for name in SOURCES]
    path = folder / f"{real}.so"
    wide = ["-Wdouble-promotion", "-DPKMCAL_FLOAT"] if real == "float" else []
    done = subprocess.run(
        [COMPILER, *FLAGS, *wide, *flags, *sources, "-o", str(path), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    pose, report = structures(REALS[real])
    return SimpleNamespace(
        compiled=ctypes.CDLL(str(path)), machine=machine, real=REALS[real], Pose=pose, Report=report
    )


def numbers(c, values):
    values = np.asarray(values, dtype=float).ravel()
    return (c.real * values.size)(*values)


def pose_of(c, T):
    return c.Pose(numbers(c, T[:3, :3]), numbers(c, T[:3, 3]))


def matrix(pose):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.reshape(pose.R, (3, 3)), pose.t
    return out


def forward(c, joints, start):
    """Status, pose and report."""
    pose, report = pose_of(c, start), c.Report(-1, -1.0, -1.0)
    status = c.compiled.pkmcal_forward(numbers(c, joints), ctypes.byref(pose), ctypes.byref(report))
    return status, matrix(pose), report


def inverse(c, T):
    out = numbers(c, np.zeros(c.machine.n_joints))
    status = c.compiled.pkmcal_inverse(ctypes.byref(pose_of(c, T)), out)
    return status, np.array(out)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Library of a catalogue machine with errors, compiled once."""
    if COMPILER is None:
        pytest.skip("NO C COMPILER (gcc or cc): the exported C source is not tested")
    reference_values = {}

    def of(name):
        if name not in reference_values:
            machine = screw_hexapod(turned=-1.0) if name == SCREWS else built(name)
            reference_values[name] = compiled(machine, tmp_path_factory.mktemp(name))
        return reference_values[name]

    return of


@needs_compiler
@pytest.mark.parametrize("name", [*sorted(catalogue()), SCREWS])
def test_c_is_our_own_kinematics(name, library):
    if (
        name != SCREWS and load_mechanism(name).redundancy
    ):  # Newton's method is for as many rows as unknowns
        with raises(InputError, code="export.not_determined"):
            library(name)
        return
    c = library(name)
    poses, joints = samples(c.machine, 15, seed=5)
    home = c.machine.home()
    rng = np.random.default_rng(6)
    motion = c.machine.layout.motion
    near = perturb(poses, 0.01 * rng.normal(size=(len(poses), 6)) @ motion @ motion.T)
    elsewhere = 0
    for T, q, start in zip(poses, joints, near, strict=True):
        status, value = inverse(c, T)
        assert status == OK
        np.testing.assert_allclose(value, c.machine.inverse(T[None])[0], atol=1e-12, rtol=0)
        for begin in (start, home):
            status, pose, report = forward(c, q, begin)
            assert status == OK
            assert report.error < 1e-13
            assert report.pivot > 0
            here = np.abs(pose - T).max() < 1e-12
            assert here or begin is home
            elsewhere += not here
        assert c.compiled.pkmcal_out_of_range(numbers(c, q)) == 0
    assert elsewhere <= 1  # Newton's method from afar may find another way to assemble a machine


@needs_compiler
@pytest.mark.parametrize(
    "name", ["gough-stewart", "3-rps", "hexaglide", "6-rus", "h4", "delta", SCREWS]
)
def test_c_jacobian_is_ours(name, library):
    c = library(name)
    for T in samples(c.machine, 5)[0]:
        out = numbers(c, np.zeros(6 * c.machine.n_joints))
        assert c.compiled.pkmcal_inverse_jacobian(ctypes.byref(pose_of(c, T)), out) == OK
        values = np.reshape(out, (-1, 6))
        np.testing.assert_allclose(values, c.machine.inverse_jacobian(T[None])[0], atol=1e-11)


@needs_compiler
@pytest.mark.parametrize("name", ["gough-stewart", "3-upu", "h4-rods"])
def test_the_self_test_passes(name, library, capfd):
    assert library(name).compiled.main() == 0
    ctypes.CDLL(None).fflush(None)
    assert f"PASS: 12 reference poses of {name}" in capfd.readouterr().out


@needs_compiler
@pytest.mark.parametrize("name", ["gough-stewart", "3-rps", "delta", "h4-rods"])
def test_a_build_in_floats_is_right_to_the_last_digits_of_floats(name, tmp_path, capfd):
    """A float has 24 bits: some of its last digits, over how well the platform is held."""
    c = compiled(built(name), tmp_path, real="float")
    assert c.compiled.main() == 0
    ctypes.CDLL(None).fflush(None)
    assert f"PASS: 12 reference poses of {name}" in capfd.readouterr().out
    poses, joints = samples(c.machine, 40, seed=5)
    for T, q in zip(poses, joints, strict=True):
        status, value = inverse(c, T)
        assert status == OK
        assert np.abs(value - q).max() < 100 * EPSILON["float"]
        for start in (T, c.machine.home()):
            status, pose, report = forward(c, q, start)
            assert status == OK
            assert report.steps < 20
            if start is T:
                off = np.abs(pose - T).max()
                assert off * min(report.pivot, 1.0) < 100 * EPSILON["float"]
        assert c.compiled.pkmcal_out_of_range(numbers(c, q)) == 0
    low, high = c.machine.joint_ranges.T
    for limit in (low, high):  # rounded to a float, a limit is still no reading beyond it
        assert c.compiled.pkmcal_out_of_range(numbers(c, limit)) == 0
    assert c.compiled.pkmcal_out_of_range(numbers(c, high + 1e-4)) == 1
    far = c.machine.home()
    far[:3, 3] += 5.0
    expected = OK if name in ("gough-stewart", "3-rps") else OUT_OF_REACH
    assert inverse(c, far)[0] == expected


@pytest.mark.skipif(CPP_COMPILER is None, reason="NO C++ COMPILER (g++): C as C++ is not tested")
@pytest.mark.parametrize("name", ["gough-stewart", "3-upu", "h4-rods"])
def test_the_source_is_c_plus_plus_as_well(name, tmp_path):
    """Arduino's .ino files are C++ 11 and newer; so is what some controllers are built of."""
    for file, text in CSource().files(source_of(built(name))).items():
        (tmp_path / file).write_text(text)
    for flags in (["-std=c++17"], ["-std=c++11", "-DPKMCAL_FLOAT", "-Wdouble-promotion"]):
        done = subprocess.run(
            [CPP_COMPILER, "-x", "c++", *flags, *WARNINGS, "-fsyntax-only", *SOURCES],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


SKETCH = Path(__file__).parents[1] / "examples" / "arduino" / "pkmcal_circle" / "pkmcal_circle.ino"
ARDUINO_MAIN = """\
#include <stdio.h>
#include <stdlib.h>
struct SerialPort {
    void begin(long) {}
    void print(const char *text) { fputs(text, stdout); }
    void print(char c) { putchar(c); }
    void print(int number) { printf("%d", number); }
    void print(unsigned long number) { printf("%lu", number); }
    void print(double number, int digits) { printf("%.*f", digits, number); }
    template <class T> void println(T value) { print(value); putchar('\\n'); }
};
static SerialPort Serial;
static unsigned long micros() { return 0; }
static void delay(unsigned long) {}
#include "SKETCH"
int main() {
    setup();
    for (int k = 0; k < 120; ++k) loop();
    return 0;
}
"""


@pytest.mark.skipif(
    CPP_COMPILER is None, reason="NO C++ COMPILER (g++): the sketch is not compiled"
)
@pytest.mark.parametrize("flags", [[], ["-DPKMCAL_FLOAT"]], ids=["double", "float"])
def test_the_arduino_sketch_goes_round(flags, tmp_path):
    """Compiled as the Arduino IDE does, the .ino as C++ 11 and the .c as C, and run on this one."""
    machine = built("delta")
    for file, text in CSource().files(source_of(machine)).items():
        (tmp_path / file).write_text(text)
    (tmp_path / "main.cpp").write_text(ARDUINO_MAIN.replace("SKETCH", str(SKETCH)))
    build = [CPP_COMPILER, "-std=gnu++11", "-Wall", "-Wextra", "-Werror", *flags, "-I", tmp_path]
    source = [COMPILER, *flags, "-std=gnu11", "-c", SOURCES[0], "-o", "kinematics.o"]
    subprocess.run(source, cwd=tmp_path, check=True)
    subprocess.run([*build, "main.cpp", "kinematics.o", "-o", "sketch"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "sketch"], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 120
    home = machine.home()
    for k, line in enumerate(lines):
        words = line.split()
        turn = 2 * np.pi * (k % 60) / 60
        T = home.copy()
        T[:2, 3] += 0.01 * np.array([np.cos(turn), np.sin(turn)])
        expected = machine.inverse(T[None])[0]
        np.testing.assert_allclose([float(word) for word in words[:3]], expected, atol=3e-6)
        assert float(words[4]) == pytest.approx(1e3 * T[0, 3], abs=2e-3)


@pytest.mark.slow
@pytest.mark.skipif(
    AVR_COMPILER is None or ARM_COMPILER is None,
    reason="NO avr-gcc OR NO arm-none-eabi-gcc: the C source is not built for controllers",
)
@pytest.mark.parametrize("name", [n for n in sorted(catalogue()) if n != "four-belt"])
def test_controllers_compilers_take_the_source(name, tmp_path):
    for file, text in CSource().files(source_of(built(name))).items():
        (tmp_path / file).write_text(text)
    cortex = [ARM_COMPILER, "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]
    avr = [AVR_COMPILER, "-mmcu=atmega2560"]
    for command in (cortex, [*cortex, "-DPKMCAL_FLOAT", "-Wdouble-promotion"], avr):
        done = subprocess.run(
            [*command, "-std=c99", "-Os", "-Wall", "-Wextra", "-Werror", "-c", SOURCES[0]],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


@needs_compiler
def test_the_files_of_the_repository_compile_as_they_stand(tmp_path):
    """The examples are a built-in machine's export, so that the C is read and compiled in its
    place.
    """
    program = tmp_path / "selftest"
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
    sources = sorted(C_SOURCE_FOLDER.glob("*.c"))
    subprocess.run([COMPILER, *flags, *sources, "-o", program, "-lm"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "PASS: 12 reference poses of gough-stewart" in done.stdout
    # behind the numbers, whose last digits are the processor's, every file is the same text
    for name, text in CSource().files(load_source("gough-stewart")).items():
        there = (C_SOURCE_FOLDER / name).read_text(encoding="utf-8")
        assert text.partition(MACHINE_NUMBERS_END)[2] == there.partition(MACHINE_NUMBERS_END)[2]
        assert text.count("\n") == there.count("\n"), f"write {name} anew: its numbers are old"


@needs_compiler
def test_the_self_test_finds_another_machine(tmp_path, capfd):
    machine = load_mechanism("delta")
    files = CSource().files(source_of(machine))
    files["pkmcal_kinematics.c"] = CSource().files(source_of(built("delta")))["pkmcal_kinematics.c"]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    program = tmp_path / "selftest"
    sources = [str(tmp_path / name) for name in SOURCES]
    subprocess.run([COMPILER, "-std=c99", *sources, "-o", program, "-lm"], check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "FAIL" in done.stdout


@needs_compiler
def test_an_old_self_test_is_not_taken_for_the_new_ones(tmp_path, monkeypatch):
    """The printed command, typed after each of two exports into one folder."""
    monkeypatch.chdir(tmp_path)
    first, second = (
        calibration(tmp_path / place, built("gough-stewart", seed=seed))
        for seed, place in ((1, "monday"), (2, "friday"))
    )
    entries = {}
    for folder, words in ((first, ()), (second, ("--json",))):
        made = run("export", folder, "--to", "c", "-o", "for my robot", *words)
        assert made.code == 0, made.err
        # the first one's program is gone before the new one is compiled
        assert not (tmp_path / "for my robot" / "pkmcal_selftest").exists()
        lines = made.out.splitlines()
        command = made.json["trial"] if words else next(x for x in lines if "(cd " in x)
        for _ in range(2):
            done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
        entries[folder] = done.stdout.splitlines()[-1]
        assert entries[folder].endswith(f"of gough-stewart ({load_source(folder).identity})")
    # both have one name, and one session's
    assert entries[first] != entries[second]
    stranger = tmp_path / "for my robot" / "a.out"
    stranger.write_text("mine")
    assert run("export", first, "--to", "c", "-o", "for my robot").code == 2
    assert stranger.read_text() == "mine"


@needs_compiler
def test_statuses(library):
    c = library("gough-stewart")
    home = c.machine.home()
    q = c.machine.inverse(home[None])[0]
    spoilt = (
        (np.full(6, np.nan), home),
        (q, np.full((4, 4), np.inf)),
        (q, np.diag([1.0, 1.0, 1.01, 1.0])),
    )
    for joints, start in spoilt:
        status, _, report = forward(c, joints, start)
        assert status == BAD_INPUT
        # the caller reads what this call wrote, not the last one's
        assert (report.steps, report.error, report.pivot) == (0, np.inf, 0.0)
    assert inverse(c, np.full((4, 4), np.nan))[0] == BAD_INPUT
    status, pose, report = forward(c, [0.2, 0.8, 0.2, 0.8, 0.2, 0.8], home)
    assert status == OUT_OF_REACH
    assert report.error > 1e-3
    np.testing.assert_array_equal(pose, home)  # the start stays
    assert c.compiled.pkmcal_out_of_range(numbers(c, q + np.eye(6)[3])) == 4
    assert c.compiled.pkmcal_out_of_range(numbers(c, q - np.eye(6)[1])) == 2
    assert c.compiled.pkmcal_out_of_range(numbers(c, np.full(6, np.nan))) == 1
    # a null report is none
    pose = pose_of(c, home)
    assert c.compiled.pkmcal_forward(numbers(c, q), ctypes.byref(pose), None) == OK


@needs_compiler
def test_cranks_and_sliders_out_of_reach(library):
    for name in ("delta", "linear-delta", "h4-rods"):
        c = library(name)
        far = c.machine.home()
        far[:3, 3] += 5.0
        assert inverse(c, far)[0] == OUT_OF_REACH


@needs_compiler
def test_a_singular_pose_is_reported(tmp_path):
    """A 3-RPR at a pose where the lines of its three legs meet in a point, so that its plate can
    turn.
    """
    machine = load_mechanism("3-rpr")
    machine = machine.with_values(_radial(machine))
    c = compiled(machine, tmp_path)
    T = np.eye(4)
    q = machine.inverse(T[None])[0]
    status, _, report = forward(c, q, T)
    assert status == SINGULAR
    assert report.pivot < 1e-9
    # and regular where the plate is turned
    T = perturb(T, np.array([0, 0, 1.2, 0, 0, 0]))
    status, _, report = forward(c, machine.inverse(T[None])[0], T)
    assert status == OK
    assert report.pivot > 0.1


def _radial(machine):
    """Platform joints on the rays to the base joints, with the plate not turned."""
    values = machine.values.copy()
    for leg in (1, 2, 3):
        base, platform = (
            machine.parameters.index(f"legs[{leg}].{side}.center.x")
            for side in ("base", "platform")
        )
        turn = 2 * np.pi * (leg - 1) / 3
        ray = np.array([-np.sin(turn), np.cos(turn)])
        values[base : base + 2], values[platform : platform + 2] = 0.32 * ray, 0.1 * ray
    return values


@needs_compiler
def test_the_limit_of_steps_and_a_name_that_cannot_leave_its_comment(tmp_path):
    machine = load_mechanism("delta")
    name = 'evil */ int x; /* "\\\n#error ??/'
    machine = replace(machine, document=machine.document.model_copy(update={"name": name}))
    c = compiled(machine, tmp_path, "-DPKMCAL_MOST_STEPS=2")
    readings = samples(machine, 20)[1]
    statuses = {forward(c, q, machine.home())[0] for q in readings}
    assert statuses == {NOT_CONVERGED}
    text = c.compiled.pkmcal_status_text
    text.restype = ctypes.c_char_p
    rows = [text(k) for k in range(6)]
    assert rows[0] == b"ok"
    assert len(set(rows)) == 6


def test_as_many_equations_as_unknowns(tmp_path):
    text = catalogue()["6-spu-passive"].read_text()
    driven = text.replace("{passive: true}", "{actuated: true, range: [0.3, 0.5]}")
    assert driven != text
    (tmp_path / "m.yaml").write_text(driven + "home: {position: [0, 0, 0.36]}\n")
    with raises(InputError, code="export.not_determined", found="7 equations for 6 unknowns"):
        CSource().files(source_of(load_mechanism(tmp_path / "m.yaml")))


def test_notes_say_what_is_left_out():
    notes = make_export(source_of(load_mechanism("6-spu-passive")), "c").notes
    assert any("Passive legs (7)" in note.text for note in notes)
    notes = make_export(source_of(load_mechanism("h4-rods")), "c").notes
    assert any("no pkmcal_inverse_jacobian" in note.text for note in notes)
