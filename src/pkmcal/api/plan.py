"""``pkmcal.plan``: the next configurations worth measuring."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from pkmcal.calibration.results import EVERYTHING
from pkmcal.calibration.saved import SavedCalibration, load
from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.judge.new_data import read
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.region import Region
from pkmcal.planning.plan import CAPTURE, MeasurementPlan
from pkmcal.planning.plan import plan as run
from pkmcal.planning.subject import CORNER, EDGE, Subject, of_machine, of_session
from pkmcal.session.load import Session, load_session, session_folder
from pkmcal.simulation.demo import demo_camera

LAST = "calibration"
"""Where calibrate writes, inside a session."""


def plan(
    subject: Session | Machine | Path | str,
    *,
    count: int = CAPTURE,
    index: Literal["tool", "D", "E", "O1"] = "tool",
    after: SavedCalibration | Path | str | None = None,
    places: int | None = None,
    camera: Camera | Path | str | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> MeasurementPlan:
    """Choose the configurations that tell most of a machine; nothing is written.

    Parameters
    ----------
    subject :
        A session, loaded or its folder, as far as it was measured already; or a machine, a
        built-in one's name or a mechanism file, for a camera that somebody thinks of.
    count :
        Configurations from each place.
    index :
        What is to be small: the tool's variance, or the indices D, E and O1.
    after :
        What is known already: a calibrated machine. Of a session with a usable calibration in its
        folder that one unless given.
    places :
        Places of the camera to choose as well; of a machine 3 unless given.
    camera :
        Of a machine: its camera or its file; a small industrial one unless given.
    seed :
        Of what is drawn.
    progress :
        Called with the share that is done, 0 to 1.

    Returns
    -------
    MeasurementPlan
        ``joints`` (n, m), ``names``, ``T_base_platform`` (n, 4, 4), in the order in which to
        measure; ``now``, ``promised`` and ``by_chance``, how sure the tool is.

    Raises
    ------
    pkmcal.errors.InputError
        What cannot be planned.

    """
    with threadpool_limits(1, "blas"):
        region: Region | None = None
        folder = None if isinstance(subject, Session | Machine) else session_folder(str(subject))
        if isinstance(subject, Session) or folder is not None:
            if camera is not None:
                raise InputError(
                    "a session has cameras of its own", where="camera", next_step="Leave it out"
                )
            session = subject if isinstance(subject, Session) else None
            session = session or load_session(folder or "", measured=False)
            wanted, region = as_it_stands(session, after, anywhere=places is not None, seed=seed)
            free = places
        else:
            if after is not None:
                raise InputError(
                    "what is known already is known of a session's machine",
                    where="after",
                    next_step="Name the session, or leave it out",
                )
            machine = subject if isinstance(subject, Machine) else load_mechanism(str(subject))
            eye = camera if isinstance(camera, Camera) else None
            eye = eye or (load_camera(camera) if isinstance(camera, Path | str) else demo_camera())
            wanted, free = of_machine(machine, [eye], machine.joint_names, seed=seed), places or 3
        return run(
            wanted, count=count, index=index, region=region, free_places=free, seed=seed,
            told=progress,
        )  # fmt: skip


def as_it_stands(
    session: Session,
    after: SavedCalibration | Path | str | None = None,
    *,
    from_drawing: bool = False,
    same_place: bool = False,
    anywhere: bool = False,
    edge: float = EDGE,
    corner: float = CORNER,
    seed: int = 0,
) -> tuple[Subject, Region | None]:
    """A session to be planned for, as far as it was measured, and its workspace.

    after : what is known already, the usable calibration in its folder unless given or
    ``from_drawing``. The rest as for :func:`~pkmcal.planning.subject.of_session`.
    """
    saved: SavedCalibration | None = None
    if after is None and not from_drawing and (session.folder / LAST / EVERYTHING).is_file():
        after = load(session.folder / LAST)
        if not after.verdict.usable:  # it says of itself not to be used
            after = None
    if after is not None:
        saved, session = read(after, session)
        if not saved.verdict.usable:
            raise InputError(
                "this calibration should not be used, so no plan is made from it",
                where=str(saved.path),
                found=saved.verdict.headline,
                next_step="Plan without it: --from-drawing",
            )
    if same_place and saved is None:
        raise InputError(
            "there is no calibration in which the cameras stood anywhere",
            where="--same-place",
            expected="--after CALIBRATION, or a session with its calibration",
        )
    found = of_session(
        session,
        saved,
        same_place=same_place,
        anywhere=anywhere,
        edge=edge,
        corner=corner,
        seed=seed,
    )
    return found, session.workspace
