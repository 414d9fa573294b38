"""``pkmcal.camera``: calibration of a camera with images of a board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from pkmcal.api.result import PAGE_DESCRIPTION, FolderResult
from pkmcal.boards.board import Board, load_board
from pkmcal.camera_calibration.calibrate import CameraCalibration, calibrate_images
from pkmcal.camera_calibration.image_files import board_file_of, image_files, session_board_images
from pkmcal.errors import InputError
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.ranges import CameraModelChoice, check_number
from pkmcal.report.camera import outcome_of
from pkmcal.wording import listed

OTHER_CAMERA_FILES = {
    "opencv": "camera.opencv.yaml",
    "ros": "camera.ros.yaml",
    "kalibr": "camera.kalibr.yaml",
}
"""Camera files of other programs, by the program."""


@dataclass(frozen=True, repr=False, eq=False)
class CameraResult(FolderResult, CameraCalibration):
    """Calibration of a camera with its files: ``camera``, ``covariance``, ``held_out``.

    images : files of the board. formats : other programs for which the camera is written as well.
    """

    images: tuple[Path, ...] = ()
    formats: tuple[str, ...] = ()

    own_files = MappingProxyType(
        {
            "camera.html": PAGE_DESCRIPTION,
            "camera.yaml": "the camera, for a session's cameras/",
            "camera.json": "everything, with covariances",
            **dict.fromkeys(OTHER_CAMERA_FILES.values(), "for that program"),
        }
    )
    kind = ("a camera's calibration", None)

    @property
    def file_list(self) -> Mapping[str, str]:
        """The files, with those for the programs in ``formats``."""
        wanted = {OTHER_CAMERA_FILES[form] for form in self.formats}
        others = {*OTHER_CAMERA_FILES.values()} - wanted
        return {name: what for name, what in self.own_files.items() if name not in others}

    @cached_property
    def outcome(self) -> Outcome:
        """Tables and sections of the page, and the camera's files."""
        others = [(OTHER_CAMERA_FILES[form], form) for form in self.formats]
        outcome = outcome_of(self, self.images, others)
        return replace(outcome, summary={**outcome.document, "files": list(self.file_list)})


def camera(
    images: Path | str | Sequence[Path | str],
    *,
    board: Board | Path | str | None = None,
    model: CameraModelChoice = "auto",
    distance: float | None = None,
    bend: bool = False,
    to: Sequence[str] = (),
    progress: Progress | None = None,
) -> CameraResult:
    """Calibrate a camera from images of a board, without writing files.

    Parameters
    ----------
    images :
        Images or folders of them, or a session whose stations observe a board.
    board :
        The board or its file; by default the session's, or board.yaml beside the images or in the
        folder above.
    model :
        Camera model; ``unified`` is for mirrors, ``auto`` selects one.
    distance :
        Distance of points from the camera, m, for the map of the projection's uncertainty beside
        that at infinity; by default the median of the boards.
    bend :
        Estimate the board's bend, two parabolas, instead of testing it only.
    to :
        Other programs whose camera file is written as well: ``opencv``, ``ros``, ``kalibr``.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    CameraResult
        ``camera``, ``covariance``, ``residuals``, ``held_out``, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        There are no images or no board, or too few images show it.

    """
    if unknown := [form for form in to if form not in OTHER_CAMERA_FILES]:
        raise InputError(
            "there is no camera file of this program",
            where="to",
            found=unknown[0],
            expected=listed(list(OTHER_CAMERA_FILES)),
        )
    check_number("camera", "distance", distance)
    with whole(progress, "Reading the board") as report:
        paths, described = _images_and_board(images, board)
        calibration = calibrate_images(paths, described, model, report, distance, bend=bend)
    return CameraResult.of(calibration, images=tuple(paths), formats=tuple(dict.fromkeys(to)))


def _images_and_board(
    images: Path | str | Sequence[Path | str], board: Board | Path | str | None
) -> tuple[list[Path], Board]:
    """Image files and the board that they show, by default the one beside them."""
    given = [Path(path) for path in ([images] if isinstance(images, Path | str) else images)]
    if len(given) == 1 and (given[0] / "session.yaml").is_file():
        paths, there = session_board_images(given[0])
    else:
        paths = image_files(given)
        there = None if board is not None else board_file_of(given)
    if isinstance(board, Board):
        return paths, board
    file = board or there or ""
    return paths, load_board(file, label=str(file))
