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
    pkmcal.show("3-rpr").save(folder / "machine" / "machine.html")
    return folder


@pytest.mark.parametrize("dark", [False, True])
def test_no_rule_of_accessibility_is_violated(pages, axe, tmp_path, dark):
    """One browser walks from the list of the folder through all of its entries."""
    script = axe + act("accessibility")
    options = (*SOFTWARE, DARK) if dark else SOFTWARE
    view = pkmcal.view(pages)
    walked = json.loads(browsed(view, script, 1440, tmp_path, *options)["pages"])
    assert len(walked) == 1 + len(view.document["entries"]) == 5
    assert len({page["title"] for page in walked}) == 5
    assert [(page["faults"], page["violations"]) for page in walked] == 5 * [("", [])]
