"""Makes examples/calibration.ipynb: cells from here, outputs by running them.

    python tools/notebook.py

Needs nbformat, nbclient and ipykernel, and the package's extra ``plot``; tests/test_examples.py
runs the cells without them. Check the notebook before you commit it.
"""

from __future__ import annotations

import tempfile
from base64 import b64decode, b64encode
from io import BytesIO
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parents[1]
PLACE = HERE / "examples" / "calibration.ipynb"
SAY, DO = "markdown", "code"
CELLS = (
    (
        SAY,
        "# A calibration in Python\n\nA simulated hexapod, built a little off its nominal model, is"
        " calibrated from images. With your own machine, `pkmcal new DIR` makes a session to"
        " fill in, `pkmcal.load_session(DIR)` loads it, and all the rest is the same.",
    ),
    (
        DO,
        'import pkmcal\n\nsession = pkmcal.simulate("bench", "gough-stewart", stations=3,'
        " configurations=5, seed=7)\nsession",
    ),
    (SAY, "## Calibrate"),
    (DO, "result = pkmcal.calibrate(session)\nresult"),
    (SAY, "The same as text:"),
    (DO, "print(result.summary())"),
    (
        SAY,
        "## Parameters\n\nValues with their standard deviations, in m and rad, and what decides"
        " them.",
    ),
    (DO, "result.parameters[6:14]"),
    (DO, 'offset = result.parameters["legs[2].length.offset"]\noffset.value, offset.sigma'),
    (DO, "%matplotlib inline\nresult.plot_parameters();"),
    (
        SAY,
        "## How good is it?\n\nResiduals in standard deviations beside what noise alone makes, and"
        " the tool before and after.",
    ),
    (DO, "result.plot_residuals();"),
    (DO, "result.plot_tool();"),
    (
        SAY,
        "How sure the tool is at poses of your own, and how far off the nominal model was"
        " there, mm:",
    ),
    (
        DO,
        "poses = result.machine.forward(session.joints[:3])\ntool = result.tool_error(poses)\n"
        "(tool.position * 1e3).round(2), (tool.off_position * 1e3).round(2)",
    ),
    (SAY, "## Save and load"),
    (DO, 'result.save("bench/calibration")\npkmcal.load_result("bench/calibration")'),
    (
        SAY,
        "`bench/calibration/report.html` is the page for people, `mechanism.yaml` the machine for"
        " controllers (`pkmcal export`). Which images would tell most next, and how sure the"
        " tool is now and would be then, m:",
    ),
    (
        DO,
        "plan = pkmcal.plan(session, count=3)\nplan.names, plan.now.position,"
        " plan.promised.position",
    ),
)


COLOURS = 24
"""Enough for plots of two colours and their edges."""


def smaller(picture: str) -> str:
    """A PNG (base64) with few colours."""
    out = BytesIO()
    image = Image.open(BytesIO(b64decode(picture))).convert("RGB")
    image.quantize(COLOURS).save(out, "png", optimize=True)
    return b64encode(out.getvalue()).decode("ascii")


def main() -> None:
    """Run the cells in a folder of their own, and write what they show."""
    make = {SAY: nbformat.v4.new_markdown_cell, DO: nbformat.v4.new_code_cell}
    cells = [make[kind](text, id=f"cell-{k}") for k, (kind, text) in enumerate(CELLS)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    book = nbformat.v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(book, resources={"metadata": {"path": folder}}, timeout=600).execute()
    for cell in book.cells:
        cell.metadata.pop("execution", None)  # when it ran
        for output in cell.get("outputs", []):
            if "<iframe" in output.get("data", {}).get("text/html", ""):
                del output.data["text/html"]  # the report, too large to be kept
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = smaller(output.data["image/png"])
    book.metadata["language_info"] = {"name": "python"}
    PLACE.write_text(nbformat.writes(book) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
