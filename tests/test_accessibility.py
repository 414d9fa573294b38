"""The pages against WCAG 2.2 A and AA, by axe-core in a browser, light and dark."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import pkmcal
from browsers import DARK, SOFTWARE
from test_view import act, browsed
from viewer_project import viewer_project


@pytest.fixture(scope="module")
def axe(tmp_path_factory) -> str:
    """The script of axe-core."""
    project = viewer_project(tmp_path_factory.mktemp("tree"))
    return (project / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def pages(demo, tmp_path_factory) -> Path:
    """A folder with a session, its calibration, a check, and a machine's page."""
    folder = tmp_path_factory.mktemp("accessible")
    shutil.copytree(demo.session, folder / "session")
    shutil.copytree(demo.calibration, folder / "session" / "calibration")
    pkmcal.check(demo.session).save(folder / "check")
    pkmcal.show("3-rpr").save(folder / "machine.html")
    return folder


REPORT = "session/calibration"


@pytest.mark.parametrize(
    ("name", "dark"),
    [
        *((name, False) for name in (".", "session", REPORT, "check", "machine.html")),
        (REPORT, True),
        *(
            pytest.param(name, True, marks=pytest.mark.slow)
            for name in (".", "session", "check", "machine.html")
        ),
    ],
)
def test_no_rule_of_accessibility_is_violated(pages, axe, tmp_path, name, dark):
    script = axe + act("accessibility")
    options = (*SOFTWARE, DARK) if dark else SOFTWARE
    root = browsed(pkmcal.view(pages / name), script, 1440, tmp_path, *options)
    assert root["faults"] == ""
    assert json.loads(root["violations"]) == []
