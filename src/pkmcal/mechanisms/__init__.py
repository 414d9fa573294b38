"""Machines as limbs between a base and a platform: closure, kinematics, parameters, files."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files import closest, listed, read_yaml, validate, yaml_text
from pkmcal.mechanisms.machine import Machine, machine_from_document
from pkmcal.mechanisms.parameters import ParameterTable
from pkmcal.mechanisms.schema import MechanismDocument

__all__ = [
    "Machine",
    "MechanismDocument",
    "ParameterTable",
    "catalogue",
    "load_mechanism",
    "machine_from_document",
    "mechanism_text",
]


def catalogue() -> dict[str, Path]:
    """The built-in machines' files by name."""
    folder = resources.files("pkmcal.mechanisms") / "catalog"
    return {Path(str(f)).stem: Path(str(f)) for f in folder.iterdir() if f.name.endswith(".yaml")}


def load_mechanism(source: Path | str, label: str | None = None) -> Machine:
    """Read a mechanism file, or a built-in machine by its name.

    Raises InputError with file, line and field for anything that the schema does not allow.
    """
    built_in = catalogue()
    path = built_in.get(str(source), Path(source))
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        guess = closest(str(source), built_in)
        raise InputError(
            what="no built-in machine and no file has this name",
            where=label,
            found=str(source),
            expected=guess or f"a mechanism file, or {listed(sorted(built_in))}",
        )
    document = read_yaml(path, label)
    checked = validate(document, MechanismDocument)
    try:
        return machine_from_document(checked, document.where)
    except InputError as error:  # a name under fixed or tied that is no parameter's
        where = error.where or ""
        raise (
            error if where.startswith(document.label) else error.located(document.label)
        ) from None


def mechanism_text(machine: Machine) -> str:
    """The machine as the text of a mechanism file, present values in it."""
    return yaml_text(machine.to_document())
