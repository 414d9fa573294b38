"""MuJoCo: a model (MJCF) with the machine's closed loops, driven by its readings."""

from __future__ import annotations

from typing import ClassVar, final

from pkmcal.calibration.source import Source
from pkmcal.export.agreement import differences
from pkmcal.export.contract import Difference, Exporter
from pkmcal.export.markup import file_name
from pkmcal.export.mujoco_model import mjcf
from pkmcal.export.mujoco_read import read
from pkmcal.outcome import Finding, Level


@final
class MujocoExporter(Exporter):
    """One file, ``<name>.xml``."""

    name: ClassVar = "mujoco"
    title: ClassVar = "MuJoCo model (MJCF) with closed loops"

    def files(self, source: Source) -> dict[str, str]:
        """The model's text."""
        return {f"{file_name(source.machine.name)}.xml": mjcf(source)}

    def check(self, files: dict[str, str], source: Source) -> list[Difference]:
        """By the text's own bodies, joints and loops."""
        return differences(read(next(iter(files.values()))), source.machine)

    def notes(self, files: dict[str, str], source: Source) -> tuple[Finding, ...]:
        """What the model does not know."""
        del files, source
        text = (
            "Masses, inertias, damping and gains in the model are placeholders: it is for "
            "kinematics. Gravity and contacts are off."
        )
        return (Finding(Level.NOTE, text),)
