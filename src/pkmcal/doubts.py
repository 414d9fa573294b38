"""Mistakes in a session that its measured poses betray, as errors that name file and place."""

from __future__ import annotations

import numpy as np

from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate, Measurements
from pkmcal.identify.pose_doubts import BAD, Doubt, find_doubt, in_doubt, wrong_scale
from pkmcal.identify.start import start_state
from pkmcal.identify.verdict import POOR, RicherModel
from pkmcal.session import Session


def check_poses(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    richer: tuple[RicherModel, ...] = (),
) -> None:
    """Raise `InputError` where one of the usual mistakes explains why poses do not fit.

    richer : models that were tried; where one of them fits, it is the model that is at fault.
    """
    if not in_doubt(estimate) or any(model.scale < BAD for model in richer):
        return
    doubt = find_doubt(session.machine, measurements, estimate)
    if doubt is not None:
        raise _error(session, doubt, estimate.statistics.pose_scale)


def richer_models(
    session: Session, measurements: Measurements, estimate: Estimate
) -> tuple[RicherModel, ...]:
    """How well the mechanism file's richer models fit, where this one is too poor for the poses."""
    if estimate.statistics.pose_scale < POOR:
        return ()
    machine = session.machine
    unknowns = machine.parameters.free_matrix().shape[1]
    out: list[RicherModel] = []
    for name in machine.document.models:
        if name == session.model:
            continue
        try:
            other = session.other_model(name)
            alike = other.n_legs == machine.n_legs or not len(measurements.edges)
            if other.parameters.free_matrix().shape[1] <= unknowns or not alike:
                continue
            start = start_state(other, measurements, estimate.state.T_camera_base)
            found = bundle(other, measurements, start)
        except (PkmcalError, np.linalg.LinAlgError):
            continue
        out.append(RicherModel(name, found.statistics.pose_scale))
    return tuple(out)


def scale_doubt(session: Session, estimate: Estimate) -> tuple[str, ...]:
    """A sentence where the whole machine came out larger or smaller than drawn."""
    scale = wrong_scale(estimate)
    if scale == 1.0 or not estimate.pose_weights.size:
        return ()
    more = "larger" if scale > 1 else "smaller"
    cause = (
        "the board's squares are not of the size that its file says. Measure them over as many as"
        " there are"
        if session.board
        else "the table's lengths have another scale"
    )
    return (
        f"All of the machine came out {abs(scale - 1):.2%} {more} than its drawing, as if {cause}:"
        " every displacement of the platform is wrong by as much.",
    )


def _error(session: Session, doubt: Doubt, scale: float) -> InputError:
    """The mistake in words."""
    left = f"with that, the poses fit {doubt.misfit:.1f} times their noise"
    joints = session.document["joints"]
    if doubt.kind == "sign":
        name = joints["columns"][doubt.motor]
        return InputError(
            f"the readings of {name} have the wrong sign",
            where=f"{joints['file']}, column {name}",
            found=f"poses that disagree with the readings {scale:.0f} times more than their noise",
            expected=f"the readings with the other sign; {left}",
            next_step="Turn the sign of this column round, or the axis in the mechanism file",
        )
    if doubt.kind == "order":
        one, other = (joints["columns"][k] for k in (doubt.motor, doubt.other))
        return InputError(
            f"the readings of {one} and {other} are exchanged",
            where=f"{joints['file']}, line 1",
            found=f"poses that disagree with the readings {scale:.0f} times more than their noise",
            expected=f"the two columns in the other order; {left}",
            next_step="Exchange the two columns, or the motors in the mechanism file",
        )
    if doubt.kind == "size":
        return InputError(
            "the board has another size than its file says",
            where=session.document["board"]["file"],
            found=f"a board {doubt.size:.4f} times as large, by how far the platform moved",
            expected=f"the size as measured with a ruler over many squares; {left}",
            next_step=f"Multiply square and marker by {doubt.size:.4f}, if a ruler agrees",
        )
    what = "the board was moved on the platform" if doubt.kind == "board moved" else \
        "the camera was moved"  # fmt: skip
    turn = np.rad2deg(np.linalg.norm(rotation_vector(doubt.moved[:3, :3])))
    shift = np.linalg.norm(doubt.moved[:3, 3]) * 1e3
    before, after = (session.configurations[k] for k in (doubt.before, doubt.configuration))
    return InputError(
        f"{what} between configuration {before} and {after}",
        where=f"session.yaml, stations.{session.station_names[doubt.station]}",
        found=f"{shift:.1f} mm and {turn:.2f} degrees; {left}",
        expected="a board screwed to the platform, and a camera that stands still",
        next_step=f"Calibrate with the configurations before {after}, or with those from it on",
    )
