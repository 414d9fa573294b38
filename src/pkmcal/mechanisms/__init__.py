"""Machines as limbs between a base and a platform: closure, kinematics, parameters, files."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files import closest, read_yaml, validate, yaml_text
from pkmcal.mechanisms.document import MechanismDocument, Model
from pkmcal.mechanisms.machine import Machine, machine_from_document, with_exact_scales
from pkmcal.mechanisms.parameters import ParameterTable
from pkmcal.wording import listed

__all__ = [
    "Machine",
    "MechanismDocument",
    "ParameterTable",
    "catalogue",
    "load_mechanism",
    "machine_from_document",
    "mechanism_text",
    "with_exact_scales",
]


def catalogue() -> dict[str, Path]:
    """The built-in machines' files by name."""
    folder = resources.files("pkmcal.mechanisms") / "catalog"
    return {Path(str(f)).stem: Path(str(f)) for f in folder.iterdir() if f.name.endswith(".yaml")}


def load_mechanism(
    source: Path | str, label: str | None = None, model: str | None = None
) -> Machine:
    """Read a mechanism file, or a built-in machine by its name.

    model : one of those that the file names; what it fixes and ties then holds instead of the
    file's own.
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
            expected=guess or f"a mechanism file, or {listed(sorted(built_in), len(built_in))}",
        )
    document = read_yaml(path, label)
    checked = validate(document, MechanismDocument)
    try:
        if model is not None:
            chosen = _model(checked, model)
            if chosen.mechanism is not None:
                return load_mechanism(_beside(path, chosen.mechanism))
            checked = checked.model_copy(update={"fixed": chosen.fixed, "tied": chosen.tied})
        return machine_from_document(checked, document.where)
    except InputError as error:  # a name under fixed or tied that is no parameter's
        where = error.where or ""
        raise (
            error if where.startswith(document.label) else error.located(document.label)
        ) from None


def _model(document: MechanismDocument, name: str) -> Model:
    """One of a machine's models by its name."""
    if name in document.models:
        return document.models[name]
    known = sorted(document.models)
    raise InputError(
        what=f"mechanism {document.name!r} has no model of this name",
        found=name,
        expected=closest(name, known) or (listed(known) if known else "no model at all"),
        next_step="name a model under models in the mechanism file, with what it fixes and ties",
    )


def _beside(path: Path, mechanism: str) -> Path | str:
    """What a model's ``mechanism`` means: a built-in machine, or a file beside this one."""
    return mechanism if mechanism in catalogue() else path.parent / mechanism


def mechanism_text(machine: Machine) -> str:
    """The machine as the text of a mechanism file, present values in it."""
    return yaml_text(machine.to_document())
