"""Machines with limbs between a base and a platform: closure equations, kinematics, parameters,
files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files import (
    LARGEST_UNITLESS_LENGTH,
    Document,
    any_unit,
    closest,
    given_path,
    read_yaml,
    validated_document,
    yaml_text,
)
from pkmcal.geometry.rigid import apply
from pkmcal.levels import NEGLIGIBLE
from pkmcal.mechanisms.disturbances import sag, tool_shift
from pkmcal.mechanisms.document import MechanismDocument
from pkmcal.mechanisms.document_checks import check_held
from pkmcal.mechanisms.machine import Machine, machine_from_document, with_exact_scales
from pkmcal.mechanisms.parameters import ParameterTable
from pkmcal.wording import listed

__all__ = [
    "Machine",
    "MechanismDocument",
    "ParameterTable",
    "catalogue",
    "check_plausible",
    "checked_machine",
    "load_mechanism",
    "machine_from_document",
    "mechanism_text",
    "with_exact_scales",
]


LARGEST_DEVIATION_SHARE = 0.25
"""Largest prior sigma as a share of the machine's size. If two points are each uncertain by more,
only the order of magnitude of their distance is known; prior sigmas of real machines are a
hundredth of it at most."""


LARGEST_OFFSET_SHARE = 0.25
"""Largest distance of a universal joint's axes as a share of the leg, up to which the leg's length
is computed to rounding; that of real joints is a twentieth."""


def catalogue() -> dict[str, Path]:
    """Files of the built-in machines by name."""
    folder = resources.files("pkmcal.mechanisms") / "catalog"
    return {Path(str(f)).stem: Path(str(f)) for f in folder.iterdir() if f.name.endswith(".yaml")}


def load_mechanism(
    source: Path | str, label: str | None = None, model: str | None = None, *, held: bool = True
) -> Machine:
    """Read a mechanism file, or a built-in machine by its name.

    Parameters
    ----------
    source :
        A built-in machine's name, or a mechanism file.
    label :
        The file's name in messages.
    model :
        One of the models that the file names; its ``fixed`` and ``tied`` replace the file's own.
    held :
        Whether the legs have to hold the platform, as for all that follows from readings.

    Raises
    ------
    pkmcal.errors.InputError
        Any content that the schema does not allow, with file, line and field.

    """
    built_in = catalogue()
    path = built_in.get(str(source)) or given_path(source, "a mechanism file or a machine's name")
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        guess = closest(str(source), built_in)
        raise InputError(
            what="no built-in machine and no file has this name",
            where=label,
            found=str(source),
            expected=guess or f"a mechanism file, or {listed(sorted(built_in), len(built_in))}",
            code="machine.unknown",
        )
    document, checked = _built_in(path, label) if str(source) in built_in else _read(path, label)
    if model is not None:
        if model not in checked.models:
            names = sorted(checked.models)
            raise InputError(
                what=f"mechanism {checked.name!r} has no model of this name",
                where=document.label,
                found=model,
                expected=closest(model, names) or (listed(names) if names else "no model at all"),
                next_step="name a model under models in the mechanism file, with what it fixes and"
                " ties",
            )
        chosen = checked.models[model]
        if chosen.mechanism is not None:
            beside = path.parent / chosen.mechanism
            other = chosen.mechanism if chosen.mechanism in built_in else beside
            return load_mechanism(other, held=held)
        checked = checked.model_copy(update={"fixed": chosen.fixed, "tied": chosen.tied})
    return replace(checked_machine(checked, document, held=held), model=model)


def _read(path: Path, label: str | None) -> tuple[Document, MechanismDocument]:
    """Document of a mechanism file, raw and validated."""
    document = read_yaml(path, label)
    return document, validated_document(document, MechanismDocument)


_built_in = cache(_read)
""":func:`_read` for built-in machines, cached because the package's own files do not change."""


def checked_machine(
    checked: MechanismDocument, document: Document, *keys: str, held: bool = True
) -> Machine:
    """Machine from a validated document whose fields are under `keys` in its file.

    held : whether its legs have to hold the platform.
    Raises InputError with file and field if the nominal model is not a machine, or is likely in
    millimetres.
    """

    def place(*inner: Any) -> str:
        return document.where(*keys, *inner)

    try:
        machine = machine_from_document(checked, place)
        if held:
            check_held(checked, place)
        machine.check_home()
    except InputError as error:
        if (error.where or "").startswith(document.label):
            raise
        raise error.located(document.where(*keys, *_role_keys(checked, str(error)))) from None
    table = machine.parameters
    lengths = np.where(np.array(table.units) == "m", np.abs(table.nominal), 0.0)
    longest = int(np.argmax(lengths))
    if lengths[longest] > LARGEST_UNITLESS_LENGTH and not any_unit(document.data):
        raise InputError(
            "the nominal model's lengths look like millimetres",
            where=document.where(*keys),
            found=f"{table.names[longest]} of {lengths[longest]:g} m",
            expected=f"metres, at most {LARGEST_UNITLESS_LENGTH:g} where no value has a unit",
            next_step="Write each length with its unit, such as 269.3 mm, or divide them by 1000;"
            " in a session also the camera's pose, and head the columns of joints.csv leg1 [mm]",
            code="mechanism.units",
        )
    for name in ("center", "offset", "radius", "arm"):
        value = getattr(checked.tolerance, name)
        check_plausible(value, machine, document.where(*keys, "tolerance", name), "a tolerance")
    _check_sag(machine, document.where(*keys, "load"))
    _check_offsets(machine, lambda leg: document.where(*keys, "legs", leg))
    return machine


def _check_offsets(machine: Machine, where: Callable[[int], str]) -> None:
    """Raise InputError for joints whose axes are apart by more than LARGEST_OFFSET_SHARE of their
    leg's length at home. where : location of a leg, from 0, in its file.
    """
    offsets = machine.layout.offsets
    if not len(offsets):
        return
    b = apply(machine.home(), machine.platform_centers())
    lengths = np.linalg.norm(b - machine.base_centers(), axis=-1)
    for leg, each in zip(offsets.leg.tolist(), offsets.offset, strict=True):
        most, widest = LARGEST_OFFSET_SHARE * lengths[leg], float(np.abs(each).max())
        if widest > most:
            raise InputError(
                f"the axes of a joint of leg {leg + 1} are too far apart for the leg",
                where=where(leg),
                found=f"{widest:g} m",
                expected=f"at most {most:.2g} m, a quarter of the leg at home",
                next_step="Write the offset in metres, or with its unit, such as 12 mm",
            )


def _check_sag(machine: Machine, where: str) -> None:
    """Raise InputError for a load that shifts the tool at home by more than NEGLIGIBLE of the
    machine's size: sag is of first order. where : location of the load in its file.
    """
    if machine.document.load is None:
        return
    home = machine.home()
    shift = float(np.linalg.norm(tool_shift(machine, home, sag(machine, home))))
    most = NEGLIGIBLE * machine.size
    if shift > most:
        raise InputError(
            "the drives yield too far under the load",
            where=where,
            found=f"{shift:.2g} m at home, by mass, center, gravity and stiffness",
            expected=f"at most {most:.2g} m, a hundredth of the machine's size",
            next_step="Write the mass in kg, the center in metres and each stiffness in N/m, of"
            " cranks in N m/rad: 1 N/um is 1e6 N/m",
        )


def check_plausible(value: float, machine: Machine, where: str, what: str) -> None:
    """Raise InputError for a standard deviation of a length, m, above LARGEST_DEVIATION_SHARE of
    the machine's size; usually the value was meant in millimetres.

    where : location of the value in its file.
    what : name of the value in the message.
    """
    most = LARGEST_DEVIATION_SHARE * machine.size
    if value <= most:
        return
    raise InputError(
        f"{what} of the machine's own size determines nothing",
        where=where,
        found=f"{value:g} m",
        expected=f"at most {most:.2g} m, a quarter of the machine's size",
        next_step=f"Write it with its unit, such as {value:g} mm, or in metres"
        if value <= 1e3 * most
        else None,
    )


def _role_keys(checked: MechanismDocument, sentence: str) -> tuple[str | int, ...]:
    """Path of the entry under ``fixed`` or ``tied`` that an error's sentence names, empty if it
    names none.
    """
    entries: list[tuple[tuple[str | int, ...], str]] = [
        (("fixed", k), name) for k, name in enumerate(checked.fixed)
    ]
    entries += [
        (("tied", g, k), name)
        for g, group in enumerate(checked.tied)
        for k, name in enumerate(group)
    ]

    def is_named(name: str) -> bool:
        return repr(name) in sentence or (bool(name) and name.removeprefix("-") in sentence)

    return next((keys for keys, name in entries if is_named(name)), ())


def mechanism_text(machine: Machine) -> str:
    """Text of a mechanism file with the machine's present values."""
    return yaml_text(machine.to_document())
