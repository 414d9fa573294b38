"""Machine in space with sliders for its readings, as ``pkmcal show`` opens it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pkmcal.arrays import Array, short_repr
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine

if TYPE_CHECKING:
    from pkmcal.calibration.saved_calibration import SavedCalibration
    from pkmcal.web.document import MachineDocument


@dataclass(frozen=True)
class MachineView:
    """Machine in 3-D, which a notebook displays.

    Attributes
    ----------
    machine :
        The machine.
    origin :
        Sentence on where its values are from.
    sigma :
        Standard deviations (P,) of its parameters, None for a nominal model.
    cameras :
        Camera and its pose T_base_camera (4, 4), m, by the station's name.

    """

    machine: Machine
    origin: str
    sigma: Array | None = None
    cameras: Mapping[str, tuple[Camera, Array]] = field(
        default_factory=lambda: MappingProxyType(dict[str, tuple[Camera, Array]]())
    )

    __repr__ = short_repr

    @cached_property
    def _swept(self) -> MachineDocument:
        """Document of a page in one file, with each reading's sweep from home."""
        return self._document(sweeps=True)

    @property
    def document(self) -> dict[str, Any]:
        """The viewer's document as it is in the page."""
        return self._swept.model_dump(mode="json")

    @property
    def html(self) -> str:
        """Page in one file."""
        from pkmcal.web.page import standalone_page

        return standalone_page(self._swept)

    def save(self, path: Path | str) -> None:
        """Write the page. Raises InputError where another program's file has this name."""
        from pkmcal.files import write_text
        from pkmcal.web.page import PAGE_MARK

        path = Path(path)
        regular = path.is_file() and not path.is_symlink()
        if os.path.lexists(path) and not (regular and PAGE_MARK.encode() in path.read_bytes()):
            raise InputError(
                "the file exists and is not a page of the viewer, so it was not replaced",
                where=str(path),
                found="a folder" if path.is_dir() else None,
                next_step="Name another file with -o",
                code="output.foreign_files",
            )
        write_text(path, self.html)

    def show(self) -> Path:
        """Write the page into a temporary folder, open it in a browser, and return its path."""
        import webbrowser
        from tempfile import mkdtemp

        from pkmcal.files import resolved

        page = resolved(Path(mkdtemp(prefix="pkmcal-"))) / "machine.html"
        self.save(page)
        webbrowser.open(page.as_uri())
        return page

    def served(self) -> MachineDocument:
        """Document of a page that asks for its poses."""
        return self._document(sweeps=False)

    def _document(self, *, sweeps: bool) -> MachineDocument:
        from pkmcal.web.machine_page import machine_document

        return machine_document(
            self.machine, origin=self.origin, sigma=self.sigma, cameras=self.cameras, sweeps=sweeps
        )

    def _repr_html_(self) -> str:
        """Page in a frame, for notebooks."""
        from pkmcal.web.page import page_frame

        return page_frame(self.html, self.machine.name)


def show(source: SavedCalibration | Machine | Path | str) -> MachineView:
    """Machine in 3-D with a slider for each joint reading, its zero and positive direction.

    Parameters
    ----------
    source :
        A machine, a built-in machine's name, a mechanism file, a session's folder (with its
        cameras at their stations' poses), a calibration's folder, or a calibration loaded by
        :func:`pkmcal.load_result`.

    Returns
    -------
    MachineView
        ``view.save("machine.html")``, ``view.show()``, ``view.document``; in a notebook it shows
        itself.

    Raises
    ------
    pkmcal.errors.InputError
        ``source`` is none of these, or its files have a fault.
    pkmcal.errors.GeometryError
        The machine cannot be assembled.

    """
    if isinstance(source, Machine):
        return MachineView(source, "A machine in memory")
    from pkmcal.calibration.machine_source import load_source

    if isinstance(source, Path | str):
        folder = Path(source)
        if (folder / "session.yaml").is_file() and not (folder / "calibration.json").is_file():
            return _of_session(folder)
    loaded = load_source(source)
    state = "calibrated values" if loaded.calibrated else "nominal values"
    if not loaded.usable:
        state += " that should not be used"
    cameras = {
        name: (camera, loaded.T_base_camera[name])
        for name, camera in loaded.cameras.items()
        if name in loaded.T_base_camera
    }
    return MachineView(
        loaded.machine, f"From {loaded.origin}, {state}", loaded.sigma, MappingProxyType(cameras)
    )


def _of_session(folder: Path) -> MachineView:
    """Nominal model of a session with its stations' rough poses."""
    from pkmcal.files import resolved
    from pkmcal.geometry.rigid import inverse
    from pkmcal.session.load import load_session

    session = load_session(folder, measured=False)
    cameras = {
        station.name: (station.camera, inverse(station.T_camera_base))
        for station in session.stations
        if station.T_camera_base is not None and not station.handheld
    }
    origin = f"From the session {resolved(folder).name}, nominal values and rough camera poses"
    return MachineView(session.machine, origin, cameras=MappingProxyType(cameras))
