"""``yaml`` and ``json``: the machine's parameters with their sigmas, for other programs."""

from __future__ import annotations

import json
from importlib.metadata import version
from typing import Any, ClassVar, final

import yaml

from pkmcal.calibration.machine_source import MachineSource
from pkmcal.exporters.contract import Difference, Exporter, commented, largest
from pkmcal.files import json_text
from pkmcal.mechanisms import mechanism_text
from pkmcal.mechanisms.machine import field_of

PLAIN_MECHANISM_FILE, PLAIN_MACHINE_FILE = "mechanism.yaml", "machine.json"
MACHINE_JSON_FORMAT = 1
CONVENTIONS = (
    "Units: m and rad; axes are unit vectors.",
    "T_a_b maps coordinates of frame b to frame a. length = scale * reading + offset, and so of"
    " what else a reading moves; a scale that does not stand here is 1. Legs count from 1.",
    "sigma is a standard deviation: of sampling, and of model errors as far as residuals show them."
    " 0 (held): by the choice of frames, or by the mechanism file.",
)


@final
class MechanismYaml(Exporter):
    """Mechanism file with the present values, which pkmcal reads as any other."""

    name: ClassVar = "yaml"
    title: ClassVar = "pkmcal's own mechanism file"
    holds_joint_offsets: ClassVar = True
    holds_effects: ClassVar = True

    def files(self, source: MachineSource) -> dict[str, str]:
        """``mechanism.yaml`` with origin and sigmas of the values in a comment on top."""
        lines = [*source.header(*CONVENTIONS), "", *source.sigma_lines()]
        return {PLAIN_MECHANISM_FILE: commented(lines, "#") + mechanism_text(source.machine)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Difference of the values, by path, read with another YAML parser than pkmcal's."""
        document = yaml.safe_load(files[PLAIN_MECHANISM_FILE])
        table = source.machine.parameters
        values = table.unit_axes(source.machine.values)
        read_again = _values_in(document, table.names)
        return [
            Difference(f"{len(read_again)} values read again", largest(read_again, values), 0.0)
        ]


@final
class MachineJson(Exporter):
    """All numbers of the machine, and the poses of its cameras, as JSON."""

    name: ClassVar = "json"
    title: ClassVar = "names, values, units, deviations and covariance"
    holds_joint_offsets: ClassVar = True
    holds_effects: ClassVar = True

    def files(self, source: MachineSource) -> dict[str, str]:
        """``machine.json``."""
        machine = source.machine
        table = machine.parameters
        values = table.unit_axes(machine.values)
        document = {
            "pkmcal_machine": MACHINE_JSON_FORMAT,
            "pkmcal": version("pkmcal"),
            "about": source.header(),
            "conventions": CONVENTIONS,
            "name": machine.name,
            "calibrated": source.calibrated,
            "usable": source.usable,
            "headline": source.headline,
            "frames": source.frames,
            "parameters": [
                {
                    "name": name,
                    "value": values[k],
                    "unit": table.units[k],
                    "sigma": source.sigma_of(name),
                }
                for k, name in enumerate(table.names)
            ],
            "covariance": source.covariance,
            "joints": [
                {"unit": unit, "range": [low, high]}
                for unit, (low, high) in zip(machine.joint_units, machine.joint_ranges, strict=True)
            ],
            "home_T_base_platform": machine.home(),
            "T_base_camera": dict(source.T_base_camera),
            "cameras": {name: camera.document() for name, camera in source.cameras.items()},
            "mechanism": machine.to_document(),
        }
        return {PLAIN_MACHINE_FILE: json_text(document)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of values and covariance, read with the standard library."""
        document = json.loads(files[PLAIN_MACHINE_FILE])
        table = source.machine.parameters
        values = table.unit_axes(source.machine.values)
        read_values = [p["value"] for p in document["parameters"]]
        again = _values_in(document["mechanism"], table.names)
        out = [
            Difference(f"{len(read_values)} values read again", largest(read_values, values), 0.0),
            Difference("values in the mechanism", largest(again, values), 0.0),
        ]
        if source.covariance is not None:
            off = largest(document["covariance"], source.covariance)
            out.append(Difference("covariance read again", off, 0.0, "m^2"))
        return out


def _values_in(document: Any, names: tuple[str, ...]) -> list[float]:
    """Values of parameters in the fields of a mechanism document."""
    return [float(node[key]) for node, key in (field_of(document, name) for name in names)]
