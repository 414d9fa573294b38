"""What the program gives, in one file of numbers, to be compared before and after a change.

    python tools/figures.py run OUT.json --data FOLDER --render FOLDER [--only NAME …]
    python tools/figures.py compare BEFORE.json AFTER.json [--within 1e-9]

``--data`` holds sessions with their truth apart (h4-board, hexapod-pinhole, hexapod-mirror),
``--render`` the scripts that score a result; neither belongs to the project. Truth is read by the
scoring alone, after the estimate. Everything goes through the command line, so the same script
measures any version. Times, dates and paths are left out.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

LEFT_OUT = re.compile(
    r"seconds|timings|time|\btook|folder|path|report|page|date|rate|python|numpy|version|files|out\b"
    r"|platform\.|opencv|scipy",
    re.IGNORECASE,
)
"""Keys whose values are of the run, not of the result."""
EXPORTS = ("json", "klipper", "linuxcnc", "mujoco", "reprap", "ros", "yaml")


def pkmcal(*words: Any, expect: tuple[int, ...] = (0, 1)) -> tuple[int, str]:
    """One command; its exit code and its output."""
    done = subprocess.run(
        [sys.executable, "-m", "pkmcal", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    if done.returncode not in expect:
        raise SystemExit(f"pkmcal {' '.join(map(str, words))}: {done.returncode}\n{done.stderr}")
    return done.returncode, done.stdout


def command(*words: Any) -> dict[str, Any]:
    """Result of a command with --json, and its exit code."""
    code, out = pkmcal(*words, "--json")
    return {"exit": code, **json.loads(out)}


def flat(value: Any, key: str = "") -> dict[str, Any]:
    """Numbers, booleans and texts of a document by their path."""
    if isinstance(value, dict):
        out: dict[str, Any] = {}
        for name, part in value.items():
            out |= flat(part, f"{key}/{name}")
        return out
    if isinstance(value, list):
        out = {}
        for k, part in enumerate(value):
            out |= flat(part, f"{key}/{k}")
        return out
    return {} if LEFT_OUT.search(key) else {key: value}


def saved(folder: Path) -> dict[str, Any]:
    """Numbers and sentences of a calibration."""
    return json.loads((folder / "calibration.json").read_text(encoding="utf-8"))


def scored(render: Path, script: str, *words: Any) -> str:
    """Output of a scoring script."""
    done = subprocess.run(
        [sys.executable, script, *map(str, words)],
        cwd=render, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.stdout.strip() or done.stderr.strip()[-300:]


def h4_score(mechanism: Path, truth: Path) -> dict[str, float]:
    """Forward kinematics at the exact readings against truth, after registration: mm, mrad."""
    import pkmcal as package

    true = json.loads(truth.read_text(encoding="utf-8"))
    forward_kinematics = np.asarray(
        package.load_mechanism(mechanism).forward(np.array(true["readings_exact"]))
    )
    reference_values = np.array(true["poses_model31_base"])
    p, q = reference_values[:, :3], forward_kinematics[:, :3, 3]
    u, _, vt = np.linalg.svd((p - p.mean(0)).T @ (q - q.mean(0)))
    rot = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    off = q - ((p - p.mean(0)) @ rot.T + q.mean(0))
    axis = forward_kinematics[:, :3, 0] @ rot
    turn = np.angle(np.exp(1j * (np.arctan2(axis[:, 1], axis[:, 0]) - reference_values[:, 3])))
    turn = np.angle(np.exp(1j * (turn - turn[0])))
    return {
        "tool_mm": 1e3 * float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        "turn_mrad": 1e3 * float(np.std(turn)),
    }


def measure(data: Path, render: Path, work: Path, only: set[str]) -> dict[str, Any]:
    """All figures, by name."""
    results: dict[str, Any] = {}

    def take(name: str, function: Any) -> None:
        if only and name not in only:
            return
        begin = time.perf_counter()
        results[name] = function()
        print(f"{name}: {time.perf_counter() - begin:.1f} s", file=sys.stderr, flush=True)

    def demo() -> Any:
        text = command("demo", "-o", work / "demo", "--no-open")
        return {"said": text, "saved": saved(work / "demo" / "calibration")}

    def calibrated(name: str, *words: str) -> Any:
        out = work / "-".join([name, *words]).replace("--", "")
        text = command("calibrate", data / name, "-o", out, *words)
        result = {"said": text, "saved": saved(out)}
        truth = data / name / "truth.json"
        if name == "h4-board":
            return result | {"score": h4_score(out / "mechanism.yaml", truth)}
        return result | {
            "score": scored(render, "score_hexapod.py", out / "mechanism.yaml", truth),
            "nees": scored(render, "nees.py", out / "calibration.json", truth),
        }

    def exported(source: Any, tag: str) -> Any:
        out = {}
        for form in EXPORTS:
            folder = work / f"export-{tag}-{form}"
            code, _ = pkmcal("export", source, "--to", form, "-o", folder, expect=(0, 1, 2))
            files = sorted(p for p in folder.rglob("*") if p.is_file()) if folder.is_dir() else []
            out[form] = {"exit": code} | {
                p.name: hashlib.sha256(_timeless(p.read_text(encoding="utf-8"))).hexdigest()
                for p in files
            }
        return out | {"c": compiled(source, work / f"export-{tag}-c")}

    take("demo", demo)
    take("hexapod-pinhole", lambda: calibrated("hexapod-pinhole"))
    take("hexapod-mirror", lambda: calibrated("hexapod-mirror"))
    for model in ("calibration", "design", "rods"):
        take(f"h4-board {model}", lambda m=model: calibrated("h4-board", "--model", m))
    for method in ("four-step", "linear"):
        take(f"pinhole {method}",
             lambda m=method: calibrated("hexapod-pinhole", "--method", m))  # fmt: skip
    take("h4 inverse-kinematic",
         lambda: calibrated("h4-board", "--method", "inverse-kinematic"))  # fmt: skip
    take("pinhole holdout", lambda: calibrated("hexapod-pinhole", "--holdout", "5"))
    take("check", lambda: command("check", data / "hexapod-pinhole"))
    take("camera", lambda: _camera(data, work))
    calibration = work / "hexapod-pinhole"
    part = work / "hexapod-pinhole-holdout-5"  # five configurations are new to this one
    take("watch", lambda: command(
        "watch", part, data / "hexapod-pinhole", "-o", work / "watch"))  # fmt: skip
    take("validate", lambda: command(
        "validate", part, data / "hexapod-pinhole", "-o", work / "validate",
        "--regions", "2"))  # fmt: skip
    take("servo", lambda: command("servo", "gough-stewart", "-o", work / "servo"))
    take("servo calibrated", lambda: command(
        "servo", calibration, "-o", work / "servo2", "--runs", "20",
        "--session", data / "hexapod-pinhole"))  # fmt: skip
    take("exports pinhole", lambda: exported(calibration, "pinhole"))
    for name in ("gough-stewart", "delta", "linear-delta", "h4", "h4-rods", "3-upu", "3-rps"):
        take(f"exports {name}", lambda n=name: exported(n, n))
    take("reproduce a", lambda: command("reproduce", "a", "-o", work / "reproduce-a"))
    take("reproduce c", lambda: command("reproduce", "c", "-o", work / "reproduce-c"))
    return results


def _timeless(text: str) -> bytes:
    """A file's text without the day and the folder."""
    text = re.sub(r"\d{4}-\d\d-\d\d[^\n]*", "", text)
    text = re.sub(r"/\S+", "", text)
    return text.encode()


def compiled(source: Any, folder: Path) -> Any:
    """Output of the exported C: its own self-test, compiled with all warnings."""
    code, _ = pkmcal("export", source, "--to", "c", "-o", folder, expect=(0, 1, 2))
    if code:
        return {"exit": code}
    test = folder / "selftest"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off"]
    sources = sorted(map(str, folder.glob("*.c")))
    subprocess.run(["cc", *flags, *sources, "-o", str(test), "-lm"], check=True)
    done = subprocess.run([str(test)], capture_output=True, text=True, check=False)
    return {"exit": code, "selftest": done.returncode}


def _camera(data: Path, work: Path) -> Any:
    folder = data / "h4-board" / "camera-photos"
    return command(
        "camera", *sorted(folder.glob("*.png")), "--board", data / "h4-board" / "board.yaml",
        "-o", work / "camera",
    )  # fmt: skip


def compare(before: dict[str, Any], after: dict[str, Any], within: float) -> int:
    """Print what differs; the number of figures that do."""
    bad = 0
    for name in before:
        if name not in after:
            print(f"{name}: not measured again")
            bad += 1
            continue
        a, b = flat(before[name]), flat(after[name])
        differ = [key for key in a if key in b and not _agree(a[key], b[key], within)]
        gone, new = [key for key in a if key not in b], [key for key in b if key not in a]
        print(f"{name}: {len(a)} values, {len(differ)} differ, {len(gone)} gone, {len(new)} new")
        for key in differ[:8]:
            print(f"    {key}: {str(a[key])[:150]} -> {str(b[key])[:150]}")
        for key in gone[:4]:
            print(f"    gone {key}: {str(a[key])[:100]}")
        bad += len(differ) + len(gone)
    return bad


def _agree(a: Any, b: Any, within: float) -> bool:
    if isinstance(a, int | float) and isinstance(b, int | float):
        return a == b or abs(a - b) <= within * max(abs(a), abs(b))
    return a == b


def main() -> int:
    """Measure, or compare two measurements."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    run = verbs.add_parser("run")
    run.add_argument("out", type=Path)
    run.add_argument("--data", type=Path, required=True)
    run.add_argument("--render", type=Path, required=True)
    run.add_argument("--only", nargs="*", default=[])
    run.add_argument("--work", type=Path)
    against = verbs.add_parser("compare")
    against.add_argument("before", type=Path)
    against.add_argument("after", type=Path)
    against.add_argument("--within", type=float, default=1e-9)
    options = parser.parse_args()
    if options.verb == "compare":
        files = (options.before, options.after)
        before, after = (json.loads(p.read_text(encoding="utf-8")) for p in files)
        return 1 if compare(before, after, options.within) else 0
    with tempfile.TemporaryDirectory() as folder:
        work = options.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        actual_names = measure(
            options.data.resolve(), options.render.resolve(), work, set(options.only)
        )
    if options.only and options.out.is_file():
        actual_names = json.loads(options.out.read_text(encoding="utf-8")) | actual_names
    options.out.write_text(json.dumps(actual_names, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
