"""``pkmcal.plan``: the next configurations worth measuring."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from pkmcal.calibration.saved import SavedCalibration
from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.region import Region
from pkmcal.planning.plan import CONFIGURATIONS_A_CAPTURE, MeasurementPlan
from pkmcal.planning.plan import plan_measurements as run
from pkmcal.planning.subject import as_it_stands, of_machine
from pkmcal.session.load import Session, load_session, session_folder
from pkmcal.simulation.demo import demo_camera


def plan(
    subject: Session | Machine | Path | str,
    *,
    count: int = CONFIGURATIONS_A_CAPTURE,
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
            wanted = as_it_stands(session, after, anywhere=places is not None, seed=seed)
            region = session.workspace
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
