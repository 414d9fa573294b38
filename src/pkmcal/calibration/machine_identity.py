"""Test whether a saved calibration and a session are of the same machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.calibration.saved_calibration import SavedCalibration, load
from pkmcal.errors import InputError
from pkmcal.levels import LARGEST_NOMINAL_ERROR
from pkmcal.session.load import Session, load_session
from pkmcal.wording import listed


def read_same_machine(
    calibration: SavedCalibration | Path | str, session: Session | Path | str
) -> tuple[SavedCalibration, Session]:
    """Saved calibration and session, loaded where they are given as paths.

    Raises InputError if they are of different machines.
    """
    saved = calibration if isinstance(calibration, SavedCalibration) else load(calibration)
    if not isinstance(session, Session):
        session = load_session(session)
    _check_joints(saved, session)
    _check_machine(saved, session)
    return saved, session


def _check_machine(saved: SavedCalibration, session: Session) -> None:
    """Raise `InputError` if the session's nominal model is that of another machine.

    The session's values are compared with the calibration's nominal and calibrated values; the
    better agreement counts. The scales of readings are not compared: they may be exact in one file,
    as in calibrations of earlier versions, and parameters in the other.
    """
    machine, drawn = saved.machine, session.machine
    rows, own = (np.flatnonzero(np.array(m.parameters.kinds) != "scale") for m in (machine, drawn))
    names, wanted = machine.parameters.names, drawn.parameters.names
    if [names[k] for k in rows] != [wanted[k] for k in own]:
        raise _another(
            f"{machine.name}, {machine.n_legs} legs, {len(machine.parameters)} parameters",
            f"{drawn.name}, {drawn.n_legs} legs, {len(drawn.parameters)} parameters",
        )
    table = drawn.parameters
    values = table.unit_axes(drawn.values)[own]
    before = saved.nominal[rows], machine.values[rows]
    off = [np.abs(values - v) / table.tolerance[own] for v in before]
    if min(o.max(initial=0.0) for o in off) > LARGEST_NOMINAL_ERROR:
        k = int(np.argmax(off[0]))
        raise _another(
            f"{wanted[own[k]]} {before[0][k]:.6g} in its nominal model",
            f"{values[k]:.6g} in the session's, {off[0][k]:.0f} tolerances off",
        )


def _another(calibrated: str, text: str) -> InputError:
    """Error for a calibration and a session of different machines."""
    return InputError(
        "the calibration is of another machine than the session",
        where="session.yaml, mechanism",
        found=text,
        expected=calibrated,
        next_step="Give the calibration of this machine, or the session's own nominal model",
        code="calibration.another_machine",
    )


def _check_joints(saved: SavedCalibration, session: Session) -> None:
    """Raise `InputError` if calibration and session name other columns of the joint readings."""
    old, new = (_columns(d) for d in (saved.document.get("session"), session.document))
    if not old or not new or old == new:
        return
    common = [name for name in new if name in old]
    raise InputError(
        "the session reads other joints than the calibration"
        if common
        else "the session and the calibration have no joint in common",
        where="joints.csv, line 1",
        found=listed(new, 8),
        expected=listed(old, 8),
        next_step="Give the calibration of this machine, with the columns in the same order",
        code="calibration.another_machine",
    )


def _columns(document: Any) -> list[str]:
    """Columns of the joint readings in a session's document; empty if it has none."""
    joints = document.get("joints") if isinstance(document, dict) else None
    columns = joints.get("columns") if isinstance(joints, dict) else None
    return [str(name) for name in columns] if isinstance(columns, list) else []
