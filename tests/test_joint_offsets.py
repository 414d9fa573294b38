"""Universal joints whose two axes do not meet: exact joints, and what names them."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.mechanisms import mechanism_text
from screw_hexapod import screw_hexapod
from test_pose_sessions import make, write_joints


def with_joint_offset(folder, offset, end, seed=0):
    """A session of a hexapod with the axes of leg 3's joint on the base or platform apart, m."""
    folder.mkdir()
    # a screw of no lead: two axes, and no equation between them
    (folder / "true.yaml").write_text(mechanism_text(screw_hexapod(0.0)))
    made = make(folder / "session", folder / "true.yaml", n=40, seed=seed)
    machine, readings = made.machine, made.joints.copy()
    leg = machine.to_document()["legs"][2]
    a, axis = (np.array(leg["base"][name]) for name in ("center", "axis"))
    for k, T in enumerate(made.T):
        b = T[:3, :3] @ leg["platform"]["center"] + T[:3, 3]
        turned = T[:3, :3] @ leg["platform"]["axis"]
        here, there, v = (a, b, axis) if end == "base" else (b, a, turned)
        across = (there - here) - ((there - here) @ v) * v
        second = here + offset * across / np.linalg.norm(across)
        change = np.linalg.norm(there - second) - np.linalg.norm(there - here)
        readings[k, 2] += change / leg["scale"]
    write_joints(made.folder, readings)
    return made.folder


@pytest.mark.parametrize("end", ["base", pytest.param("platform", marks=pytest.mark.slow)])
def test_axes_that_do_not_meet_are_named(end, tmp_path):
    offset = 3e-3
    result = calibrate_session(with_joint_offset(tmp_path / end, offset, end))
    (one,) = result.violations
    assert (one.code, one.of) == ("machine.joint_offset", "leg 3")
    facts = one.finding.facts
    assert facts["side"] == end
    assert facts["value"] == pytest.approx(offset, abs=4 * facts["sigma"])
    assert facts["sigma"] < offset / 4


def test_axes_that_meet_are_not_named(tmp_path):
    result = calibrate_session(with_joint_offset(tmp_path / "right", 0.0, "base"))
    assert not result.violations
    assert result.verdict.usable
