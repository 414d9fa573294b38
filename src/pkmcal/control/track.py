"""One photograph to the edges of the seen legs, fast enough for control.

The readings say where the platform is (forward kinematics, from the last pose, so the assembly
mode stays), and what the last photograph found beside that prediction is carried on. So the edges
are looked for within a pixel and a half of where they should be, by the same measurement as in a
calibration (:func:`pkmcal.observe.legs.measure`). Where fewer than half of the legs were found, the
next photograph is first searched ten pixels wide (:func:`pkmcal.observe.legs.search`), so that none
takes much longer than the others. The first one, before which nothing moves, is looked at in both
ways, and what shows more edges counts.

A leg shows up to two edges a tube. All that were measured are one line in space, four numbers, so
they are joined by least squares, and the leg is answered as two edges of one radius: what the
control laws work on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.control.seen import SeenMachine
from pkmcal.control.track_fit import EdgeRows, LegLines, corrected_pose, edge_rows, leg_lines
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.observe import profiles
from pkmcal.observe.distance import DistanceTables
from pkmcal.observe.legs import Photographs, StationEdges, measure, search

HIDDEN = "hidden behind another leg or outside the photograph"
FAR = 0.7
"""Median distance (px) of edges from their prediction from which none is believed: of legs that
turned away more than that, the ends that still lie within reach pass for whole edges."""
SEARCH_ROUNDS = 3
"""Gauss-Newton steps of the pose after a search: ten pixels are far enough to bend the way."""


@dataclass(frozen=True)
class Sight:
    """What is looked at: the machine as believed, in the camera that stands before it.

    edge_shift : px by which all edges lie outward of where they should, as calibrated.
    """

    seen: SeenMachine
    camera: Camera
    edge_shift: float = 0.0


@dataclass(frozen=True)
class TrackState:
    """What one photograph tells the next.

    T_base_platform : (4, 4) pose that the readings gave. correction : (6,) by which the edges lay
    beside it (left perturbation). found : (L,) seen legs that were found. blur : px, NaN before
    legs were found for the first time. searched : whether they had to be searched.
    """

    T_base_platform: Array
    correction: Array
    found: Booleans
    blur: float = float("nan")
    searched: bool = False


@dataclass(frozen=True)
class TrackedLegs:
    """The seen legs in one photograph; L seen legs, camera frame.

    lines : normals (L, 2, 3) with tangent bases and covariances, NaN where lost.
    found : (L,). reasons : (L,) why a leg is lost, "" where it is not.
    T_base_platform : (4, 4) pose that the edges show, near the one that the readings give.
    closed : False where no pose fits the readings. beside : m, the largest error of a rod's length
    that this pose means: readings that are late, or another photograph's. state : for the next one.
    """

    lines: LegLines
    found: Booleans
    reasons: tuple[str, ...]
    T_base_platform: Array
    closed: bool
    beside: float
    state: TrackState


def start_state(seen: SeenMachine, start: Array | None = None) -> TrackState:
    """Before the first photograph; start : (4, 4) pose near which the machine stands."""
    begin = seen.machine.home() if start is None else start
    none = np.zeros(len(seen.legs), dtype=bool)
    return TrackState(np.asarray(begin, dtype=float), np.zeros(6), none)


def warm_up(blur: float) -> None:
    """Fill the tables of edge profiles for a blur (px), so that no photograph waits for them."""
    samples = len(profiles.profile_offsets())
    width = np.repeat(profiles.HALF_WIDTHS, samples)
    cut = np.tile(np.arange(samples), len(profiles.HALF_WIDTHS))
    grey = np.zeros((len(width), samples))
    profiles.locate(profiles.Profiles(grey, np.ones(len(width)), width, cut), blur)


def track(sight: Sight, state: TrackState, image: Integers, readings: Array) -> TrackedLegs:
    """Edges of the seen legs in one photograph.

    image : (height, width) uint8 grey levels. readings : (m,) m or rad. Raises InputError for an
    image that is not this camera's.
    """
    check_image(image, sight.camera)
    forward = sight.seen.machine.forward_result(readings, state.T_base_platform)
    if not bool(forward.converged):
        return _lost(sight, state, "the readings cannot be the machine's")
    closed, first = forward.T_base_platform, np.isnan(state.blur)
    photograph = _photograph(sight.camera, image, readings)
    predicted = perturb(closed, state.correction)
    searched = not first and _poor(state.found) and not state.searched
    if searched:
        predicted = _searched(sight, photograph, predicted)
    at = _look(sight, photograph, predicted, state.blur)
    if first:
        again = _look(sight, photograph, _searched(sight, photograph, predicted), state.blur)
        searched = again.evidence > at.evidence
        at = again if searched else at
    return _tracked(sight, state, closed, at, searched)


def _poor(found: Booleans) -> bool:
    """Fewer than half of the legs: the prediction is at fault and not what hides them."""
    return 2 * int(found.sum()) < len(found)


def _tracked(
    sight: Sight, state: TrackState, closed: Array, at: _Look, searched: bool
) -> TrackedLegs:
    """The answer of a look about the pose that the readings give, (4, 4)."""
    found, blur = at.lines.found, state.blur
    if found.any() and np.isnan(blur):
        blur = at.look.blur
        warm_up(blur)
    T = closed if _poor(found) else corrected_pose(sight.seen, at.predicted, at.rows, found)
    correction = pose_difference(T, closed)
    beside = np.abs(at.rows.closure.by_pose @ correction)
    next_state = TrackState(closed, correction, found, blur, searched)
    reasons = _reasons(sight, at)
    return TrackedLegs(at.lines, found, reasons, T, True, float(beside.max()), next_state)


@dataclass(frozen=True)
class _Look:
    """A sub-pixel look about a predicted pose (4, 4), and the legs' lines from it; far : the
    prediction was so wrong that they are not believed.
    """

    predicted: Array
    look: StationEdges
    rows: EdgeRows
    lines: LegLines
    far: bool

    @property
    def evidence(self) -> tuple[int, float]:
        """More edges are better, then smaller distances from the prediction."""
        return (0 if self.far else len(self.rows.leg), -self.look.moved)


def _look(sight: Sight, photograph: Photographs, predicted: Array, blur: float) -> _Look:
    seen = sight.seen
    known = None if np.isnan(blur) else blur
    look = measure(photograph, seen.machine, seen.T_camera_base, predicted[None], known)
    rows = edge_rows(seen, photograph.joints[0], predicted, look.edges, sight.edge_shift)
    far = look.moved > FAR
    lines = LegLines.nothing(len(seen.legs)) if far else leg_lines(seen, rows)
    return _Look(predicted, look, rows, lines, far)


def _searched(sight: Sight, photograph: Photographs, predicted: Array) -> Array:
    """The pose (4, 4) that the wide search gives."""
    seen, readings = sight.seen, photograph.joints[0]
    look = search(photograph, seen.machine, seen.T_camera_base, predicted[None])
    every = np.ones(len(seen.legs), dtype=bool)
    for _ in range(SEARCH_ROUNDS):
        rows = edge_rows(seen, readings, predicted, look.edges, sight.edge_shift)
        predicted = corrected_pose(seen, predicted, rows, every)
    return predicted


def _reasons(sight: Sight, at: _Look) -> tuple[str, ...]:
    if at.far:
        return ("its edges are not where they were predicted",) * len(sight.seen.legs)
    out: list[str] = []
    for leg, found, agrees in zip(sight.seen.legs, at.lines.found, at.lines.agrees, strict=True):
        mine = [r.reason for r in at.look.rejected if r.leg == leg]
        shown = [reason for reason in mine if reason != HIDDEN]
        why = (shown or mine or ["only one of its sides is seen"])[0]
        out.append("" if found else why if agrees else "its edges do not belong to one leg")
    return tuple(out)


def _photograph(camera: Camera, image: Integers, readings: Array) -> Photographs:
    no_tables = DistanceTables(np.zeros((1, 1, 1, 1)), 1.0)
    return Photographs(0, camera, np.zeros(1, dtype=int), readings[None], [image], no_tables)


def _lost(sight: Sight, state: TrackState, reason: str) -> TrackedLegs:
    count = len(sight.seen.legs)
    none = np.zeros(count, dtype=bool)
    lines = LegLines.nothing(count)
    state = replace(state, found=none)
    reasons = (reason,) * count
    return TrackedLegs(lines, none, reasons, state.T_base_platform, False, 0.0, state)


def check_image(image: Integers, camera: Camera) -> None:
    """Raise InputError where an image is not one grey-level photograph of this camera."""
    if image.dtype != np.uint8 or image.ndim != 2:
        raise InputError(
            what="the photograph is not an array of grey levels",
            found=f"{image.dtype} of shape {image.shape}",
            expected="uint8 of shape (height, width)",
            next_step="convert it, for example with cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)",
        )
    size = (image.shape[1], image.shape[0])
    if size != tuple(camera.image_size):
        raise InputError(
            what="the photograph has another size than its camera",
            found=f"{size[0]}x{size[1]} pixels",
            expected=f"{camera.image_size[0]}x{camera.image_size[1]}, as the camera file says",
            next_step="set the camera to that size; scaled photographs do not fit its calibration",
        )
