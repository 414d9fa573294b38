"""LinuxCNC: kinematics modules compiled against its headers' words, and the real one, headless."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from export_sources import built, source_of
from pkmcal.exporters.contract import make_export
from pkmcal.exporters.linuxcnc import LINUXCNC_INI_FILE, ini_words, world
from pkmcal.exporters.samples import samples
from pkmcal.mechanisms import load_mechanism, machine_from_document
from test_export_firmware import ideal_linear, put

COMPILER = shutil.which("gcc") or shutil.which("cc")
LINUXCNC, HALCOMPILE = shutil.which("linuxcnc"), shutil.which("halcompile")
DRIVER = Path(__file__).with_name("linuxcnc_driver.py")
DRIVER_PYTHON = "/usr/bin/python3"
"""Debian's, which has LinuxCNC's own module."""
needs_linuxcnc = pytest.mark.skipif(
    LINUXCNC is None or HALCOMPILE is None,
    reason="NO LINUXCNC (Debian's linuxcnc-uspace, linuxcnc-uspace-dev): exports are not run in it",
)
PATIENCE = 150.0
"""s, for a run: some twenty on an idle computer."""
JOINT_AGREEMENT = 1e-6
"""mm or degrees: G-code's words have nine digits behind the point."""
SIMULATION_INI = """\
[EMC]
VERSION = 1.1
MACHINE = test
[DISPLAY]
DISPLAY = ./driver.sh
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[RS274NGC]
PARAMETER_FILE = linuxcnc.var
[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 4.0
SERVO_PERIOD = 1000000
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
TOOL_TABLE = tool.tbl
[HAL]
HALFILE = machine.hal
"""
JOINT_SPEED_INI = "MAX_VELOCITY = 500\nMAX_ACCELERATION = 5000\nFERROR = 1000\nMIN_FERROR = 1000\n"
TRAJECTORY_INI = (
    "MAX_LINEAR_VELOCITY = 300\nMAX_LINEAR_ACCELERATION = 3000\nDEFAULT_LINEAR_VELOCITY = 300\n"
    "MAX_ANGULAR_VELOCITY = 100\nMAX_ANGULAR_ACCELERATION = 1000\nDEFAULT_ANGULAR_VELOCITY = 100\n"
)
AXIS_INI = (
    "[AXIS_{letter}]\nMIN_LIMIT = -1e6\nMAX_LIMIT = 1e6\nMAX_VELOCITY = 300\n"
    "MAX_ACCELERATION = 3000\n"
)


def leaning_delta():
    """Towers that are not parallel: lineardeltakins leaves millimetres."""
    machine = put(ideal_linear(), 1, base__axis=[0.02, 0.01, 1.0])
    return put(machine, 2, base__axis=[-0.01, 0.015, 1.0])


def settings(folder, machine, changes=(), hal=""):
    """An export in the environment of a simulated machine; returns its texts."""
    files = make_export(source_of(machine), "linuxcnc").files
    for name, text in files.items():
        (folder / name).write_text(text)
    ini = files[LINUXCNC_INI_FILE]
    for old, new in changes:
        assert old in ini
        ini = ini.replace(old, new)
    joints = int(ini[ini.index("JOINTS = ") :].split()[2])
    letters = ini[ini.index("COORDINATES = ") :].split()[2]
    for n in range(joints):
        ini = ini.replace(f"[JOINT_{n}]\n", f"[JOINT_{n}]\n{JOINT_SPEED_INI}")
    ini = ini.replace("[TRAJ]\n", f"[TRAJ]\n{TRAJECTORY_INI}")
    axes = "".join(AXIS_INI.format(letter=letter) for letter in letters)
    (folder / "test.ini").write_text(f"{SIMULATION_INI}\n{ini}\n{axes}")
    (folder / "tool.tbl").write_text("")
    (folder / "driver.sh").write_text(f'#!/bin/sh\nexec {DRIVER_PYTHON} {DRIVER} "$@"\n')
    (folder / "driver.sh").chmod(0o755)
    # encoders that stand where the machine is at home; once the drives are on they follow commands
    at = ini_words(files[LINUXCNC_INI_FILE], "HOME") - ini_words(
        files[LINUXCNC_INI_FILE], "HOME_OFFSET"
    )
    lines = [
        "loadrt [KINS]KINEMATICS",
        "loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS",
        f"loadrt mux2 count={joints}",
        "addf motion-command-handler servo-thread",
        "addf motion-controller servo-thread",
        "net estop iocontrol.0.user-enable-out iocontrol.0.emc-enable-in",
        "net prepare iocontrol.0.tool-prepare iocontrol.0.tool-prepared",
        "net change iocontrol.0.tool-change iocontrol.0.tool-changed",
    ]
    for n in range(joints):
        lines += [
            f"addf mux2.{n} servo-thread",
            f"setp mux2.{n}.in0 {float(at[n])!r}",
            f"net command{n} joint.{n}.motor-pos-cmd mux2.{n}.in1",
            f"net on{n} joint.{n}.amp-enable-out mux2.{n}.sel",
            f"net place{n} mux2.{n}.out joint.{n}.motor-pos-fb",
        ]
    pins = files.get("pkmcal_kinematics.hal", "")
    (folder / "machine.hal").write_text("\n".join([*lines[:2], pins, *lines[2:], hal]) + "\n")
    return files, letters


def ran(folder, machine, **orders):
    """The driver's answer after a run of LinuxCNC."""
    orders = {"joints": machine.n_joints, "poses": [], **orders}
    (folder / "orders.json").write_text(json.dumps(orders))
    own = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "PYTHONPATH")}
    own |= {"HOME": str(folder), "RTAPI_FIFO_PATH": str(folder / "fifo")}
    if os.getuid() == 0:  # LinuxCNC needs another user
        own["RTAPI_UID"] = "65534"
        for above in (folder, *folder.parents[: len(folder.parents) - 2]):
            above.chmod(above.stat().st_mode | 0o055)
        folder.chmod(0o777)
    # into a file: a pipe would stay open as long as a process of LinuxCNC's does
    with (folder / "log.txt").open("w") as log:
        subprocess.run(
            [LINUXCNC, "-r", "test.ini"],
            cwd=folder,
            env=own,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            timeout=PATIENCE,
            check=False,
        )
    end_processes(f"RTAPI_FIFO_PATH={own['RTAPI_FIFO_PATH']}")
    assert (folder / "answer.json").exists(), (folder / "log.txt").read_text()
    return json.loads((folder / "answer.json").read_text())


def end_processes(variable):
    """Kill what runs with an environment variable: LinuxCNC 2.9.0 leaves its rtapi_app behind, in a
    session of its own.
    """
    for file in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # of another user, or gone
            if variable.encode() in file.read_bytes().split(b"\0"):
                os.kill(int(file.parent.name), signal.SIGKILL)


def middle_poses(machine, count, seed=0):
    """Poses of readings in the middle of their ranges, and the readings: so that straight lines
    from one to the next stay within limits.
    """
    rng = np.random.default_rng(seed)
    low, high = machine.joint_ranges.T
    share = rng.uniform(0.35, 0.65, (4 * count, machine.n_joints))
    fk = machine.forward_result(low + share * (high - low))
    poses = fk.T_base_platform[fk.converged][:count]
    return poses, machine.inverse(poses)


def joints_of(ini, readings):
    """LinuxCNC's joints (n, J) of readings, by the comments in the sections."""
    rates = [float(word) for word in re.findall(r"^# joint \d = (\S+) \* reading", ini, re.M)]
    return np.array(rates) * readings + ini_words(ini, "HOME_OFFSET")


@pytest.fixture
def module():
    """Builds and installs a kinematics module, and removes it."""
    there = Path("/usr/lib/linuxcnc/modules/pkmcal_kins.so")

    def install(folder):
        if there.exists() or not os.access(there.parent, os.W_OK):
            pytest.skip(f"{there} CANNOT BE WRITTEN: the kinematics module is not run in LinuxCNC")
        done = subprocess.run(
            [HALCOMPILE, "--install", "pkmcal_kins.c"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        installed.append(there)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stdout + done.stderr

    installed = []
    yield install
    for path in installed:
        path.unlink(missing_ok=True)


RUN_MACHINES = {
    "hexapod": lambda: built("gough-stewart"),
    "linear delta": lambda: load_mechanism("linear-delta"),
    "leaning delta": leaning_delta,
    "rotary delta": lambda: built("delta"),
    "hexaglide": lambda: built("hexaglide"),
    "h4": lambda: built("h4"),
}


@pytest.mark.slow
@needs_linuxcnc
@pytest.mark.parametrize("name", RUN_MACHINES)
def test_linuxcnc_homes_without_a_move_and_is_right_at_thirty_poses(name, tmp_path, module):
    machine = RUN_MACHINES[name]()
    files, letters = settings(tmp_path, machine)
    own_module = "pkmcal_kins.c" in files
    assert own_module == (name not in ("hexapod", "linear delta"))
    if own_module:
        module(tmp_path)
    ini = files[LINUXCNC_INI_FILE]
    poses, readings = middle_poses(machine, 30)
    words = [
        {c: float(x) for c, x in zip("XYZABC", row, strict=True) if c in letters}
        for row in world(poses)
    ]
    beyond = {**words[-1], "Z": words[-1]["Z"] + 400}
    answer = ran(tmp_path, machine, poses=words, beyond=beyond)
    # homing moves no motor, and gives joints by the encoders
    assert answer["homed"]
    assert answer["errors"] == []
    np.testing.assert_allclose(answer["motors"], answer["motors before"], atol=1e-9)
    np.testing.assert_allclose(answer["home"], ini_words(ini, "HOME"), atol=1e-9)
    hal = files.get("pkmcal_kinematics.hal", "")
    legs = [int(leg) - 1 for leg in re.findall(r"Motor \d is leg \d, joint (\d)", hal)]
    joints = joints_of(ini, readings[:, legs] if legs else readings)
    # LinuxCNC's linear delta follows the nominal machine to 0.035 mm
    limit = 0.1 if name == "linear delta" else JOINT_AGREEMENT
    assert len(answer["poses"]) == 30
    np.testing.assert_allclose(answer["poses"], joints, atol=limit, rtol=0)
    # a pose out of reach is refused, and nothing moves
    assert answer["refused"]
    np.testing.assert_allclose(answer["beyond"], answer["poses"][-1], atol=1e-9)


@pytest.mark.slow
@needs_linuxcnc
def test_values_for_encoders_move_nothing_where_there_are_none(tmp_path):
    """Words that a user may forget to change: HOME_OFFSET, and velocities for a switch."""
    machine = built("gough-stewart")
    settings(tmp_path, machine, [("HOME_ABSOLUTE_ENCODER = 2", "HOME_ABSOLUTE_ENCODER = 0")])
    answer = ran(tmp_path, machine, homes=False)
    assert not answer["homed"]
    assert any("invalid homing config" in text for text in answer["errors"])
    np.testing.assert_allclose(answer["motors"], answer["motors before"], atol=1e-9)


@pytest.mark.slow
@needs_linuxcnc
def test_a_machine_put_home_by_hand_is_homed_where_it_is(tmp_path):
    machine = built("gough-stewart")
    ini = make_export(source_of(machine), "linuxcnc").files[LINUXCNC_INI_FILE]
    home = re.findall(r"^HOME = (\S+)$", ini, re.M)
    offsets = re.findall(r"^HOME_OFFSET = (\S+)$", ini, re.M)
    changes = [
        ("HOME_ABSOLUTE_ENCODER = 2", "HOME_ABSOLUTE_ENCODER = 0"),
        ("HOME_LATCH_VEL = 1", "HOME_LATCH_VEL = 0"),
        *(
            (f"HOME_OFFSET = {a}\n", f"HOME_OFFSET = {b}\n")
            for a, b in zip(offsets, home, strict=True)
        ),
    ]
    settings(tmp_path, machine, changes)
    answer = ran(tmp_path, machine)
    assert answer["homed"]
    np.testing.assert_allclose(answer["motors"], answer["motors before"], atol=1e-9)
    np.testing.assert_allclose(answer["home"], np.array(home, dtype=float), atol=1e-9)


@pytest.mark.slow
@needs_linuxcnc
def test_with_switches_the_joints_go_to_their_lengths_at_home(tmp_path):
    """Without HOME they would all go to 0, with soft limits off."""
    machine = built("gough-stewart")
    ini = make_export(source_of(machine), "linuxcnc").files[LINUXCNC_INI_FILE]
    home, offsets = ini_words(ini, "HOME"), ini_words(ini, "HOME_OFFSET")
    away = 3.0  # mm, of each switch from home
    changes = [
        ("HOME_ABSOLUTE_ENCODER = 2", "HOME_ABSOLUTE_ENCODER = 0"),
        ("HOME_SEARCH_VEL = 0", "HOME_SEARCH_VEL = 10"),
        ("HOME_LATCH_VEL = 1", "HOME_LATCH_VEL = -1"),
    ]
    changes += [
        (f"HOME_OFFSET = {a}\n", f"HOME_OFFSET = {h + away!r}\n")
        for a, h in zip(re.findall(r"^HOME_OFFSET = (\S+)$", ini, re.M), home.tolist(), strict=True)
    ]
    switches = [f"loadrt comp count={machine.n_joints}"]
    for n in range(machine.n_joints):
        switches += [
            f"addf comp.{n} servo-thread",
            f"setp comp.{n}.in0 {float(home[n] - offsets[n] + away)!r}",
            f"net place{n} comp.{n}.in1",
            f"net switch{n} comp.{n}.out joint.{n}.home-sw-in",
        ]
    settings(tmp_path, machine, changes, "\n".join(switches))
    answer = ran(tmp_path, machine)
    assert answer["homed"], answer["errors"]
    np.testing.assert_allclose(answer["home"], home, atol=1e-6)
    # where they were before, to what a latch at 1 mm/s leaves
    np.testing.assert_allclose(answer["motors"], home - offsets, atol=0.02)


# Without LinuxCNC: the module's text, compiled against its headers' words

HEADERS = {
    "kinematics.h": """\
typedef struct { double x, y, z; } PmCartesian;
typedef struct EmcPose { PmCartesian tran; double a, b, c, u, v, w; } EmcPose;
typedef enum { KINEMATICS_IDENTITY = 1, KINEMATICS_BOTH } KINEMATICS_TYPE;
typedef unsigned long int KINEMATICS_FORWARD_FLAGS, KINEMATICS_INVERSE_FLAGS;
KINEMATICS_TYPE kinematicsType(void);
int kinematicsInverse(const EmcPose *, double *, const KINEMATICS_INVERSE_FLAGS *,
                      KINEMATICS_FORWARD_FLAGS *);
int kinematicsForward(const double *, EmcPose *, const KINEMATICS_FORWARD_FLAGS *,
                      KINEMATICS_INVERSE_FLAGS *);
int kinematicsSwitchable(void);
#define KINS_NOT_SWITCHABLE int kinematicsSwitchable(void) {return 0;}
""",
    "hal.h": "int hal_init(const char *name);\nint hal_ready(int id);\nint hal_exit(int id);\n",
    "rtapi.h": "",
    "rtapi_app.h": (
        "#define EXPORT_SYMBOL(name) struct unused_##name\n"
        "#define MODULE_LICENSE(text) struct unused_license\n"
        "int rtapi_app_main(void);\nvoid rtapi_app_exit(void);\n"
    ),
}


class World(ctypes.Structure):
    _fields_ = (("values", ctypes.c_double * 9),)


def compiled_module(machine, folder):
    """The exported module as a library, its headers those above."""
    files = make_export(source_of(machine), "linuxcnc").files
    for name, text in {**files, **HEADERS}.items():
        (folder / name).write_text(text)
    done = subprocess.run(
        [COMPILER, "-std=c99", "-O1", "-shared", "-fPIC", "-Wall", "-Wextra", "-pedantic-errors",
         "-Werror", "-I.", "pkmcal_kins.c", "-o", "module.so", "-lm"],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(folder / "module.so"), mode=os.RTLD_LAZY), files


def turned_home(name):
    """Machine whose home is turned about z, which no coordinate of its platform can represent."""
    machine = load_mechanism(name)
    home = machine.document.home.model_copy(update={"rotation_vector": (0.0, 0.0, 0.1)})
    return machine_from_document(machine.document.model_copy(update={"home": home}))


@pytest.mark.skipif(COMPILER is None, reason="NO C COMPILER: LinuxCNC's module is not compiled")
@pytest.mark.parametrize(
    ("machine", "letters"),
    [
        (leaning_delta, "XYZ"),
        pytest.param(lambda: built("delta"), "XYZ", marks=pytest.mark.slow),
        (lambda: built("3-rpr"), "XYC"),
        pytest.param(lambda: built("h4"), "XYZC", marks=pytest.mark.slow),
        (lambda: turned_home("h4"), "XYZC"),
        pytest.param(lambda: built("hexaglide"), "XYZABC", marks=pytest.mark.slow),
        (lambda: built("6-rus"), "XYZABC"),
    ],
    ids=["leaning delta", "rotary delta", "3-rpr", "h4", "h4 turned", "hexaglide", "6-rus"],
)
def test_a_module_is_the_machine_in_linuxcncs_units(machine, letters, tmp_path):
    machine = machine()
    module, files = compiled_module(machine, tmp_path)
    ini = files[LINUXCNC_INI_FILE]
    assert f"COORDINATES = {letters}\n" in ini
    poses, readings = samples(machine, 20, seed=3)
    coordinates = world(poses)
    if "A" not in letters:  # counted from home
        coordinates[:, 3:] -= world(machine.home()[None])[0][3:]
    joints = (ctypes.c_double * 16)()
    expected = joints_of(ini, readings)
    last = World()  # of all zeros, as LinuxCNC has it before
    for row, wanted in zip(coordinates, expected, strict=True):
        queries = [x if c in letters else 0.0 for c, x in zip("XYZABC", row, strict=True)]
        at = World((ctypes.c_double * 9)(*queries))
        assert module.kinematicsInverse(ctypes.byref(at), joints, None, None) == 0
        np.testing.assert_allclose(joints[: machine.n_joints], wanted, atol=1e-9)
        # from next to it, as from one cycle to the next, with an angle of a whole turn more
        near = [x + 0.5 * (c in letters) for c, x in zip("XYZABC", queries, strict=True)]
        near[5] += 360.0 * ("C" in letters)
        back = World((ctypes.c_double * 9)(*near))
        assert module.kinematicsForward(joints, ctypes.byref(back), None, None) == 0
        queries[5] += 360.0 * ("C" in letters)
        np.testing.assert_allclose(list(back.values), [*queries, 0, 0, 0], atol=1e-7)
    assert module.kinematicsForward(joints, ctypes.byref(last), None, None) == 0
    far = World((ctypes.c_double * 9)(5e3, 5e3, 5e3, 0, 0, 0))
    assert module.kinematicsInverse(ctypes.byref(far), joints, None, None) == (
        0 if letters in ("XYC",) else -1
    )


@pytest.mark.skipif(COMPILER is None, reason="NO C COMPILER: LinuxCNC's module is not compiled")
def test_a_module_lets_no_joint_jump_to_its_other_place(tmp_path):
    """Above its carriage a rod would stand: within the limits, but by a jump of the joint."""
    machine = leaning_delta()
    module, files = compiled_module(machine, tmp_path)
    joints = (ctypes.c_double * 16)()
    high = np.max(ini_words(files[LINUXCNC_INI_FILE], "MAX_LIMIT"))
    for z in np.arange(0.0, 900.0, 5.0):
        at = World((ctypes.c_double * 9)(0, 0, z))
        status = module.kinematicsInverse(ctypes.byref(at), joints, None, None)
        # refused by the module, or by LinuxCNC's own limits
        assert status == -1 or min(joints[:3]) > z
        if z > high:
            assert status == -1 or max(joints[:3]) > high
