"""User interface for LinuxCNC that homes, moves, and records the positions.

linuxcnc_driver.py -ini FILE

It runs with the Python that has LinuxCNC's own module. Its orders are ``orders.json`` beside the
INI file, its answer ``answer.json``. Orders: ``joints``, their number; ``poses``, by letter, one
for each move; ``beyond``, coordinates that limits refuse; ``homes``, whether homing is expected to
succeed. Answers: joints, and commands to motors, before homing and after it; joints at each pose;
texts of errors.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import linuxcnc

FOLDER = Path(sys.argv[sys.argv.index("-ini") + 1]).resolve().parent
PATIENCE = 60.0  # s, for any one thing


def waited(stat, condition):
    """Whether a condition came true in time."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        stat.poll()
        if condition():
            return True
        time.sleep(0.02)
    return False


def errors_of(channel):
    """Texts of all errors so far."""
    out = []
    while True:
        value = channel.poll()
        if not value:
            return out
        out.append(value[1])


def still(stat, joints):
    """Commanded joints, when they have stopped."""
    last = [None]

    def same():
        now = [stat.joint[n]["output"] for n in range(joints)]
        before, last[0] = last[0], now
        return now == before

    time.sleep(0.1)
    waited(stat, same)
    return last[0]


def motors(joints):
    """Positions that the motors are commanded to."""
    pins = [f"joint.{n}.motor-pos-cmd" for n in range(joints)]
    return [
        float(subprocess.run(["halcmd", "getp", pin], capture_output=True, check=True).stdout)
        for pin in pins
    ]


def main():
    orders = json.loads((FOLDER / "orders.json").read_text())
    command, stat, channel = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
    joints = orders["joints"]
    waited(stat, lambda: stat.joints == joints)
    command.state(linuxcnc.STATE_ESTOP_RESET)
    command.wait_complete()
    command.state(linuxcnc.STATE_ON)
    command.wait_complete()
    waited(stat, lambda: stat.task_state == linuxcnc.STATE_ON)
    time.sleep(0.3)
    stat.poll()
    answer = {
        "before": [stat.joint[n]["output"] for n in range(joints)],
        "motors before": motors(joints),
    }
    command.mode(linuxcnc.MODE_MANUAL)
    command.wait_complete()
    command.teleop_enable(0)
    command.wait_complete()
    command.home(-1)

    def homed():
        return all(stat.homed[:joints])

    if orders.get("homes", True):
        waited(stat, homed)
    else:
        time.sleep(2.0)
    answer["home"] = still(stat, joints)
    answer["motors"] = motors(joints)
    answer["homed"] = homed()
    answer["errors"] = errors_of(channel)
    answer["poses"] = []
    if homed() and orders["poses"]:
        command.mode(linuxcnc.MODE_MDI)
        command.wait_complete()
        for words in orders["poses"]:
            command.mdi("G1 F6000 " + " ".join(f"{c}{v:.9f}" for c, v in words.items()))
            command.wait_complete(PATIENCE)
            answer["poses"].append(still(stat, joints))
        answer["world"] = list(stat.position)
        answer["errors"] += errors_of(channel)
        command.mdi("G1 F6000 " + " ".join(f"{c}{v:.9f}" for c, v in orders["beyond"].items()))
        command.wait_complete(PATIENCE)
        answer["beyond"] = still(stat, joints)
        answer["refused"] = errors_of(channel)
    (FOLDER / "answer.json").write_text(json.dumps(answer))


main()
