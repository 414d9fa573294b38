"""MuJoCo with an exported model; machines to export: of the catalogue, not built as drawn, and with
parts that none there has.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pkmcal.files import parse_yaml, validated_document, yaml_text
from pkmcal.geometry.rigid import pose
from pkmcal.mechanisms import (
    MechanismDocument,
    catalogue,
    load_mechanism,
    machine_from_document,
)
from screw_hexapod import offset_fields

LOUD = "NO MUJOCO: exported models were not loaded in it (pip install mujoco)"
CATALOGUE = sorted(catalogue())
# Joints, motions and homes that no machine of the catalogue has, as (change of) mechanism files.
MADE = {
    "3-spr": """
name: 3-spr
motion: spatial
legs:
  - base: {joint: spherical, center: [0.0, 0.18, 0.0]}
    platform: {joint: revolute, center: [0.0, 0.28, 0.0], axis: [1, 0, 0]}
    length: {actuated: true, range: [0.33, 0.45]}
  - base: {joint: universal, center: [-0.1559, -0.09, 0.0], axis: [0.3, 0.1, 0.9]}
    platform: {joint: revolute, center: [-0.2425, -0.14, 0.0], axis: [-0.5, 0.8660254038, 0]}
    length: {actuated: true, offset: 0.02, range: [0.33, 0.45]}
    tubes: [{radius: 0.01, from: 0.02, to: 0.2}]
  - base: {joint: spherical, center: [0.1559, -0.09, 0.0]}
    platform: {joint: revolute, center: [0.2425, -0.14, 0.0], axis: [-0.5, -0.8660254038, 0]}
    length: {actuated: true, range: [0.33, 0.45]}
""",
    "rpr-and-spu": """
name: rpr-and-spu
motion: spatial
legs:
  - base: {joint: revolute, center: [0.2, 0.0, 0.0], axis: [0, 1, 0]}
    platform: {joint: revolute, center: [0.1, 0.0, 0.0], axis: [0, 1, 0]}
    length: {actuated: true, range: [0.3, 0.42]}
  - base: {joint: spherical, center: [-0.2, 0.15, 0.0]}
    platform: {joint: universal, center: [-0.05, 0.1, 0.0], axis: [1, 0, 0]}
    length: {actuated: true, range: [0.3, 0.42]}
  - base: {joint: spherical, center: [-0.2, -0.15, 0.0]}
    platform: {joint: universal, center: [-0.1, -0.05, 0.0]}
    length: {actuated: true, range: [0.3, 0.42]}
  - base: {joint: spherical, center: [0.05, 0.25, 0.0]}
    platform: {joint: spherical, center: [-0.1, 0.12, 0.0]}
    length: {actuated: true, range: [0.3, 0.42]}
""",
    "3-rrr": """
name: 3-rrr
motion: planar
legs:
  - base: {joint: crank, center: [0.3, 0.0, 0.1], axis: [0, 0, 1], zero: [0, 1, 0],
      arm: 0.15, angle: 0.2, range: [-0.5, 0.5]}
    platform: {joint: revolute, center: [0.08, 0.02, 0.1]}
    length: {actuated: false, constant: 0.2}
  - base: {joint: crank, center: [-0.15, 0.26, 0.1], axis: [0, 0, 1], zero: [-0.866, -0.5, 0],
      arm: 0.15, angle: 0.2, range: [-0.5, 0.5]}
    platform: {joint: revolute, center: [-0.0573, 0.0593, 0.1]}
    length: {actuated: false, constant: 0.2}
  - base: {joint: slider, center: [-0.2, -0.25, 0.1], axis: [1, 0.2, 0], range: [-0.05, 0.05]}
    platform: {joint: revolute, center: [-0.0227, -0.0793, 0.1]}
    length: {actuated: false, constant: 0.25}
home: {position: [0.0, 0.0, 0.0], rotation_vector: [0, 0, 0.1]}
""",
    "six-rod-delta": """
name: six-rod-delta
motion: spatial
legs:
  - base: {joint: slider, center: [-0.1012, -0.09, 0], axis: [0, 0, 1],
      motor: 1, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [-0.0103, -0.0375, 0]}
    length: {actuated: false, constant: 0.27}
  - base: {joint: slider, center: [-0.1412, -0.05, 0], axis: [0, 0, 1],
      motor: 1, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [-0.0503, 0.0025, 0]}
    length: {actuated: false, constant: 0.27}
  - base: {joint: slider, center: [0.1012, -0.09, 0], axis: [0, 0, 1],
      motor: 2, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [0.0103, -0.0375, 0]}
    length: {actuated: false, constant: 0.27}
  - base: {joint: slider, center: [0.1412, -0.05, 0], axis: [0, 0, 1],
      motor: 2, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [0.0503, 0.0025, 0]}
    length: {actuated: false, constant: 0.27}
  - base: {joint: slider, center: [0.03, 0.14, 0], axis: [0, 0, 1],
      motor: 3, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [0.03, 0.035, 0]}
    length: {actuated: false, constant: 0.27}
  - base: {joint: slider, center: [-0.03, 0.14, 0], axis: [0, 0, 1],
      motor: 3, range: [0.25, 0.55]}
    platform: {joint: spherical, center: [-0.03, 0.035, 0]}
    length: {actuated: false, constant: 0.27}
home: {position: [0.0, 0.0, 0.15]}
""",
}
MADE["offset axes"] = yaml_text(offset_fields(0.012, -0.009, tubes=True))
MADE["offset base"] = yaml_text(offset_fields(0.012, None, tubes=True))
TURNED = {
    "turned h4": ("h4", "[0.0, 0.0, -0.45]", "[0, 0, 0.3]"),
    "tilted delta": ("delta", "[0.01, 0.0, -0.22]", "[0.1, -0.1, 0.2]"),
    "barred delta": ("delta", "[0.0, 0.0, -0.22]", "[0, 0, 0.1]"),
    "turned h4-rods": ("h4-rods", "[0.02, 0.0, -0.45]", "[0, 0, 0.2]"),
}
BUILT_WRONG = ("3-rps", "delta", "gough-stewart", "h4-rods")
"""Machines of either motion and every kind of closure; the other machines, with errors, are slow
tests."""
AS_DRAWN = ("3-rpr", "3-upu", "6-rus", "6-spu-passive", "four-belt", "hexaglide")
"""Machines whose kind of joints none of the above and of the turned ones has; the others are slow
tests."""
ALL = [
    *(pytest.param(n, marks=() if n in AS_DRAWN else pytest.mark.slow) for n in CATALOGUE),
    *(pytest.param(f"wrong {n}", marks=() if n in BUILT_WRONG else pytest.mark.slow)
      for n in CATALOGUE),
    *MADE,
    *TURNED,
]  # fmt: skip


def made(text):
    return machine_from_document(
        validated_document(parse_yaml(text, Path("m.yaml")), MechanismDocument)
    )


def machine_of(name):
    """A machine of the catalogue, one that is not built as drawn, or one of the above."""
    if name in MADE:
        return made(MADE[name])
    if name in TURNED:
        of, position, vector = TURNED[name]
        text = catalogue()[of].read_text(encoding="utf-8")
        text = re.sub(r"(?m)^home:.*$", "", text)
        if name.startswith("barred"):
            text = re.sub(
                r"joint: spherical, center: \[0, 0.035, 0\]",
                "joint: bar, center: [0, 0.03, 0.002], hinge: [0, 0.005, 0], bar: 1",
                text,
            )
        return made(f"{text}\nhome: {{position: {position}, rotation_vector: {vector}}}\n")
    nominal = load_mechanism(name.removeprefix("wrong "))
    if not name.startswith("wrong"):
        return nominal
    rng = np.random.default_rng(CATALOGUE.index(nominal.name))
    table = nominal.parameters
    # the H4's axes are drawn to 2 degrees; half of that leaves its home within reach
    error = 0.5 * table.tolerances_free() * rng.normal(size=len(table.free_names()))
    return nominal.with_values(table.nominal + table.free_matrix() @ error)


class Simulated:
    """A model in MuJoCo."""

    def __init__(self, text):
        self.mj = pytest.importorskip("mujoco", reason=LOUD)
        self.model = self.mj.MjModel.from_xml_string(text)
        self.model.opt.jacobian = self.mj.mjtJacobian.mjJAC_DENSE
        self.data = self.mj.MjData(self.model)
        joints = self.model.actuator_trnid[:, 0]
        self.qpos = self.model.jnt_qposadr[joints]
        self.dofs = self.model.jnt_dofadr[joints]
        self.platform = self.model.body("platform").id
        self.home()

    def home(self):
        self.mj.mj_resetDataKeyframe(self.model, self.data, 0)
        self.mj.mj_forward(self.model, self.data)

    def closure(self):
        """Equality constraints (E,), m and rad, and their derivatives (E, nv)."""
        self.mj.mj_fwdPosition(self.model, self.data)
        n = self.data.ne
        return self.data.efc_pos[:n], self.data.efc_J.reshape(-1, self.model.nv)[:n]

    def drive(self, readings, pieces=12):
        """Forward kinematics without a spring: Gauss-Newton on MuJoCo's own constraints, the
        driven joints held at readings (m,) that approach the goal; never at our pose.
        """
        goal = readings / self.model.actuator_gear[:, 0]
        free = np.setdiff1d(np.arange(self.model.nv), self.dofs)
        begin = self.data.qpos[self.qpos].copy()
        for share in np.linspace(0, 1, pieces + 1)[1:]:
            self.data.qpos[self.qpos] = begin + share * (goal - begin)
            for _ in range(20):
                value, by = self.closure()
                step = np.zeros(self.model.nv)
                step[free] = -np.linalg.lstsq(by[:, free], value, rcond=1e-10)[0]
                self.mj.mj_integratePos(self.model, self.data.qpos, step, 1)
                if np.abs(step).max() < 1e-13:
                    break
        return self.pose()

    def pose(self):
        rot = self.data.xmat[self.platform].reshape(3, 3).copy()
        return pose(rot, self.data.xpos[self.platform].copy())
