"""New data beside a calibration: are they the same machine's, what of them is new, and where it is.

The calibrated machine, free within its drawing's tolerances, is the best guess of where to look in
the photographs; only what was measured, and where poses and stations are, is kept of that.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Booleans
from pkmcal.calibration.calibrate import Calibration, Progress, calibrate
from pkmcal.calibration.saved import SavedCalibration, load
from pkmcal.errors import InputError
from pkmcal.session.load import Session, digests, load_session
from pkmcal.session.readings import same_pose
from pkmcal.wording import listed

FAR = 10.0
"""Tolerances by which two drawings of one machine may differ: a corrected number, not another
machine's."""


def read(
    calibration: SavedCalibration | Path | str, session: Session | Path | str
) -> tuple[SavedCalibration, Session]:
    """Both, where they are not loaded. Raises InputError where the session is another machine's."""
    saved = calibration if isinstance(calibration, SavedCalibration) else load(calibration)
    if not isinstance(session, Session):
        session = load_session(session)
    _check_joints(saved, session)
    _check_machine(saved, session)
    return saved, session


def known_rows(saved: SavedCalibration, session: Session) -> Booleans:
    """(K,) configurations of a session that the calibration used.

    By their photographs; without any (a tracker's), or for a calibration that lists none, by the
    readings: two measurements of a pose do not agree to the last digit.
    """
    entries: list[dict[str, Any]] = saved.document["configurations"]
    used = [*compress(entries, saved.used)]
    old = {digest for entry in used for digest in entry.get("photographs", ())}
    new = digests(session) if old else {}
    same = np.any(np.all(session.joints[:, None] == saved.joints[saved.used], axis=2), axis=1)
    return np.array(
        [
            bool(old & set(new[name])) if name in new else bool(alike)
            for name, alike in zip(session.configurations, same, strict=True)
        ]
    )


def repeated_rows(saved: SavedCalibration, session: Session) -> Booleans:
    """(K,) configurations of a session at poses that the calibration used, by the readings."""
    used = saved.joints[saved.used]
    owner = same_pose(np.concatenate([used, session.joints]), session.joint_noise)
    return owner[len(used) :] < len(used)


def check_new(known: Booleans, seen: Booleans, what: str, expected: str, next_step: str) -> None:
    """Raise `InputError`, in these words, where nothing that was seen is new to the calibration."""
    if not np.any(seen & ~known):
        used = int(np.sum(seen & known))
        raise InputError(
            what,
            found=f"{used} configurations, all of them used",
            expected=expected,
            next_step=next_step,
        )


def look(
    saved: SavedCalibration, session: Session, seed: int, told: Progress, share: float
) -> Calibration:
    """The session measured, and a first estimate of where everything is; see the module. Its own
    session is without the photographs by hand that were not placed, and stations are numbered so.

    seed : of the search for the stations. told : gets the first ``share`` of the progress.
    """
    return calibrate(
        replace(session, machine=saved.machine),
        seed=seed,
        progress=lambda text, part: told(text, share * part),
    )


def _check_machine(saved: SavedCalibration, session: Session) -> None:
    """Raise `InputError` where the session is another machine's.

    Readings' scales tell no machine from another: the one may have them exact, as calibrations of
    earlier versions have, and the other not.
    """
    machine, drawn = saved.machine, session.machine
    rows, own = (np.flatnonzero(np.array(m.parameters.kinds) != "scale") for m in (machine, drawn))
    told, wanted = machine.parameters.names, drawn.parameters.names
    if [told[k] for k in rows] != [wanted[k] for k in own]:
        raise _another(
            f"{machine.name}, {machine.n_legs} legs, {len(machine.parameters)} parameters",
            f"{drawn.name}, {drawn.n_legs} legs, {len(drawn.parameters)} parameters",
        )
    table = drawn.parameters
    values = table.unit_axes(drawn.values)[own]
    before = saved.drawing[rows], machine.values[rows]
    off = [np.abs(values - v) / table.tolerance[own] for v in before]
    if min(o.max(initial=0.0) for o in off) > FAR:
        k = int(np.argmax(off[0]))
        raise _another(
            f"{wanted[own[k]]} {before[0][k]:.6g} in its drawing",
            f"{values[k]:.6g} in the session's, {off[0][k]:.0f} tolerances off",
        )


def _another(calibrated: str, found: str) -> InputError:
    return InputError(
        "the calibration is of another machine than the session",
        where="session.yaml, mechanism",
        found=found,
        expected=calibrated,
        next_step="Give the calibration of this machine, or the session's own drawing",
    )


def _check_joints(saved: SavedCalibration, session: Session) -> None:
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
    )


def _columns(document: Any) -> list[str]:
    """The readings' columns by a session's document, empty where it tells none."""
    joints = document.get("joints") if isinstance(document, dict) else None
    columns = joints.get("columns") if isinstance(joints, dict) else None
    return [str(name) for name in columns] if isinstance(columns, list) else []
