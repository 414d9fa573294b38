"""The examples, run as a reader runs them."""

from __future__ import annotations

import io
import json
import re
import runpy
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest

from pkmcal.placement.default_camera import camera_of_size
from pkmcal.session.load import load_session

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run_example(name: str, *words) -> SimpleNamespace:
    """One example as a program; in this process, because imports take a second."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    command = [str(EXAMPLES / name), *(str(word) for word in words)]
    with (
        redirect_stdout(out),
        redirect_stderr(err),
        patch.object(sys, "argv", command),
    ):
        try:
            runpy.run_path(command[0], run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
    return SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def test_a_folder_of_images_becomes_a_table(demo):
    done = run_example("servo_from_folder.py", demo.session, demo.calibration)
    assert done.returncode == 0, done.stderr
    title, *lines = done.stdout.splitlines()
    assert "station1" in title
    images = sorted(p.stem for p in (demo.session / "images" / "station1").iterdir())
    rows = [line.split() for line in lines if not line.startswith(" " * 8)]
    assert [row[0] for row in rows] == images
    speeds = [[float(v) for v in row[1:7]] for row in rows]
    assert any(any(speed) for speed in speeds)
    # at the goal itself, hardly anything is left: of what is seen, not of what legs that are hidden
    # leave to a speed
    errors = [float(row[7]) for row in rows if row[7] != "nan"]
    assert errors[-1] < 0.05 * max(errors)


def test_what_is_not_in_the_session_is_named(demo):
    done = run_example("servo_from_folder.py", demo.session, demo.calibration, "--station", "attic")
    assert done.returncode == 2
    assert "no such station; found attic" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_calibration_is_held_beside_its_truth(demo):
    done = run_example("against_truth.py", demo.session, demo.calibration)
    assert done.returncode == 0, done.stderr
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines()}
    values = json.loads(demo.run.out)["comparison"]  # the demonstration's own figures
    for name in ("drawing", "calibrated"):
        assert float(rows[name][1]) == pytest.approx(1e3 * values[name]["centre"], abs=6e-4)
        assert float(rows[name][3]) == pytest.approx(1e3 * values[name]["position"], abs=6e-4)
    assert float(rows["calibrated"][3]) < 0.25 * float(rows["drawing"][3])
    assert "without a pose" not in done.stdout
    done = run_example("against_truth.py", demo.calibration, demo.calibration)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_nominal_model_that_cannot_take_the_readings_has_no_figures(demo, tmp_path):
    """Outside the machine's pose; NaN for programs."""
    session = shutil.copytree(demo.session, tmp_path / "session")
    path = session / "mechanism.yaml"
    path.write_text(path.read_text().replace("[0.2693, 0.02,", "[0.9, 0.02,"))
    done = run_example("against_truth.py", session, demo.calibration)
    assert done.returncode == 0, done.stderr
    assert "nan" not in done.stdout
    count = len(load_session(session).configurations)
    assert f"without a pose at {count} of {count} readings" in done.stdout


def test_numbered_pictures_stand_in_for_a_camera(demo):
    source = demo.session / "images" / "station1" / "%04d.png"
    words = (demo.calibration, "station1", "--goal", "0000", "--source", source)
    done = run_example("servo_live.py", *words)
    assert done.returncode == 0, done.stderr
    count = len(list(source.parent.iterdir()))
    assert f"{count} frames; the source gives no more" in done.stdout
    assert len(re.findall(r"\d ms  ", done.stdout)) == count
    done = run_example("servo_live.py", *words, "--send")
    assert done.returncode == 2
    assert "no controller to send velocities to" in done.stderr


def test_without_a_camera_one_sentence_states_so(demo):
    words = (demo.calibration, "station1", "--goal", "0000", "--source", "nothing.mp4")
    done = run_example("servo_live.py", *words)
    assert done.returncode == 2
    assert done.stderr.startswith("the source of pictures cannot be opened; found nothing.mp4")
    assert "Traceback" not in done.stderr


BOOK = json.loads((EXAMPLES / "calibration.ipynb").read_text(encoding="utf-8"))


def text_of(source) -> str:
    """Text of a notebook's strings, which may be lists of lines."""
    return "".join(source)


def test_the_notebook_is_small_and_names_no_place_of_one_computer():
    assert (EXAMPLES / "calibration.ipynb").stat().st_size < 100_000
    for cell in BOOK["cells"]:
        for output in cell.get("outputs", []):
            assert output["output_type"] in ("execute_result", "display_data", "stream")
            assert output.get("name") != "stderr"
            display = {"text/plain": output.get("text", ""), **output.get("data", {})}
            rows = [text_of(text) for kind, text in display.items() if kind != "image/png"]
            assert not re.search(r"/(home|root|tmp|work|Users)/", " ".join(rows))


@pytest.mark.slow
@pytest.mark.usefixtures("quick_plans")
def test_the_notebook_runs(tmp_path, monkeypatch):
    """The notebook's cells in order, as Jupyter would run them, on smaller images; outputs are not
    compared to the digit, as they differ between computers.
    """
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pkmcal.api.simulate.default_camera", lambda: camera_of_size((240, 180)))
    namespace: dict[str, object] = {}
    for cell in BOOK["cells"]:
        if cell["cell_type"] == "code":
            source = re.sub(r"^%.*$", "", text_of(cell["source"]), flags=re.MULTILINE)
            exec(compile(source, "calibration.ipynb", "exec"), namespace)
    assert namespace["result"].verdict.usable
    assert (tmp_path / "bench" / "calibration" / "report.html").is_file()
    summary = next(
        text_of(cell["outputs"][0]["text"]) for cell in BOOK["cells"]
        if "result.summary()" in text_of(cell["source"])
    )  # fmt: skip
    stored, present = (
        [re.sub(r"[\d.]+", "#", line.partition(":")[0]) for line in text.splitlines()[:7]]
        for text in (summary, namespace["result"].summary())
    )
    assert stored == present
    from matplotlib import pyplot

    pyplot.close("all")
