"""Sources of exports: machines that differ from their nominal model, and calibrations on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pkmcal.calibration.machine_source import MachineSource
from pkmcal.cameras.files import camera_text
from pkmcal.cameras.pinhole import Pinhole
from pkmcal.files import json_text
from pkmcal.geometry.rigid import inverse, look_at
from pkmcal.mechanisms import load_mechanism, machine_from_document, mechanism_text

CAMERA = Pinhole((640, 480), np.array([600.0, 601.0, 320.5, 239.25, -0.1, 0.05, 1e-3, -2e-3, 0.01]))


def built(name, seed=1, share=0.3):
    """Catalogue machine that differs from its nominal model by a share of its tolerances, and in
    its readings' scales, cranks' too, by that share of a thousandth.
    """
    machine = with_scales(load_mechanism(name), 1e-3)
    table = machine.parameters
    sigma = table.tolerances_free()
    z = share * sigma * np.random.default_rng(seed).normal(size=sigma.size)
    return machine.with_values(table.nominal + table.free_matrix() @ z)


def with_scales(machine, tolerance):
    """The machine with all readings' scales as parameters."""
    document = machine.document
    values = document.tolerance.model_copy(update={"scale": tolerance})
    return machine_from_document(document.model_copy(update={"tolerance": values}))


def source_of(machine, **more):
    return MachineSource(machine, **{"origin": "a test", **more})


def calibration(folder: Path, machine, *, usable=True, camera=CAMERA, session=True) -> Path:
    """A calibration's folder as calibrate writes it, two stations, in its session's folder."""
    home = folder / "shots"
    out = home / "calibration"
    out.mkdir(parents=True)
    if session:
        (home / "session.yaml").write_text("pkmcal_session: 1\n")
        (home / "cameras").mkdir()
        (home / "cameras" / "a.yaml").write_text(camera_text(camera))
    table = machine.parameters
    rng = np.random.default_rng(2)
    root = 1e-4 * rng.normal(size=(len(table), len(table)))
    places = (np.array([0.9, 0.2, 0.4]), np.array([-0.8, 0.4, 0.5]))
    up = np.array([0.0, 0.0, 1.0])
    stations = [
        {
            "name": name,
            "camera": "cameras/a.yaml",
            "T_base_camera": inverse(look_at(place, np.zeros(3), up)),
            "sigma_rotation": [0.001] * 3,
            "sigma_translation": [0.002] * 3,
        }
        for name, place in zip(("front", "left side"), places, strict=True)
    ]
    document = {
        "pkmcal_calibration": 1,
        "verdict": {
            "usable": usable,
            "headline": "Calibrated: well." if usable else "This calibration should not be used.",
            "reasons": [] if usable else ["The rods cannot be told apart."],
            "warnings": [],
            "advice": [],
        },
        "method": "bundle",
        "seed": 0,
        "gauge": "three centres: legs 1, 3, 5",
        "parameters": [
            {"name": n, "drawing": d, "value": v, "data_share": 1.0}
            for n, d, v in zip(table.names, table.nominal, _values(machine), strict=True)
        ],
        "covariance": root @ root.T,
        "stations": stations,
        "configurations": [],
        "mechanism": machine.to_document(),
        "session": {"folder": home.name},
    }
    (out / "calibration.json").write_text(json_text(document))
    (out / "mechanism.yaml").write_text(mechanism_text(machine))
    return out


def _values(machine):
    return machine.parameters.unit_axes(machine.values)
