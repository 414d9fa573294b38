"""Source of a machine for export or control: calibration, mechanism file or built-in machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.file_names import CALIBRATED_MECHANISM_FILE, CALIBRATION_DOCUMENT_FILE
from pkmcal.calibration.saved_calibration import SavedCalibration, load
from pkmcal.cameras.contract import Camera
from pkmcal.cameras.files import camera_path, load_camera, written_camera
from pkmcal.errors import InputError, legible
from pkmcal.files import closest, given_path, resolved
from pkmcal.geometry.rigid import inverse
from pkmcal.identify.tool import pose_by_parameters
from pkmcal.mechanisms import Machine, catalogue, load_mechanism
from pkmcal.wording import listed

SESSION_FILE = "session.yaml"
"""File that identifies a session's folder."""


@dataclass(frozen=True, eq=False)
class MachineSource:
    """A machine to export or to control, with its uncertainty; equal to itself only.

    machine : with the values to use.
    sigma, covariance : (P,) and (P, P) of its parameters; None for a nominal model.
    cameras, T_base_camera : intrinsics, and poses (4, 4) in metres, by station; a station's camera
        is missing if its file was not found.
    headline : the verdict of the calibration in one sentence.
    usable : False for a refused calibration; reasons : its reasons.
    origin : name of the folder, file or built-in machine.
    calibrated : False for a nominal model.
    frames : the gauge.
    sigma_camera : (6,) by station, of T_base_camera, rad and m, base axes.
    bed : z (m, base frame) of the platform's origin on a bed whose heights were measured, or None.
    bed_by_parameters, bed_sigma : (P,) its derivative by the parameters, at the readings with which
        the bed was probed, and its standard deviation (m) beside them; None where unknown.
    session : the calibration's session and its digest, as text; empty for a nominal model.
    """

    machine: Machine
    sigma: Array | None = None
    cameras: Mapping[str, Camera] = field(
        default_factory=lambda: MappingProxyType(dict[str, Camera]())
    )
    T_base_camera: Mapping[str, Array] = field(
        default_factory=lambda: MappingProxyType(dict[str, Array]())
    )
    headline: str = "Nominal model only, not calibrated."
    usable: bool = True
    origin: str = ""
    covariance: Array | None = None
    reasons: tuple[str, ...] = ()
    calibrated: bool = False
    frames: str = "as in the mechanism file"
    sigma_camera: Mapping[str, Array] = field(
        default_factory=lambda: MappingProxyType(dict[str, Array]())
    )
    bed: float | None = None
    bed_by_parameters: Array | None = None
    bed_sigma: float | None = None
    session: str = ""

    @property
    def identity(self) -> str:
        """Origin of the values and their short digest, because many calibrations share a name."""
        values = np.asarray(self.machine.values + 0.0, dtype="<f8")
        digest = blake2b(values.tobytes(), digest_size=4).hexdigest()
        parts = (self.origin, self.session, f"values {digest}", "" if self.usable else "refused")
        return ", ".join(part for part in parts if part)

    def sigma_of(self, name: str) -> float | None:
        """Standard deviation of a parameter, m or rad; None if unknown."""
        if self.sigma is None or name not in self.machine.parameters.names:
            return None
        return float(self.sigma[self.machine.parameters.index(name)])

    def header(self, *conventions: str) -> tuple[str, ...]:
        """Lines for the top of an exported file: machine, origin, verdict, frames, conventions."""
        state = "" if self.usable else "REFUSED, NOT TO BE USED: "
        lines = (
            f"Machine {self.machine.name}, exported by pkmcal {version('pkmcal')}"
            f" from {self.identity}.",
            state + " ".join((self.headline, *self.reasons)),
            f"Frames: {self.frames}.",
            *conventions,
        )
        # a name may contain a line break; the rest must stay a comment
        return tuple(legible(" ".join(line.split())) for line in lines)

    def sigma_lines(self, kinds: Sequence[str] = ()) -> list[str]:
        """One line for each parameter, of some kinds or of all: name, value, unit and standard
        deviation.
        """
        table = self.machine.parameters
        values = table.unit_axes(self.machine.values)
        out: list[str] = []
        for k, name in enumerate(table.names):
            if kinds and table.kinds[k] not in kinds:
                continue
            sigma = self.sigma_of(name)
            unit = f" {table.units[k]}" if table.units[k] in ("m", "rad") else ""
            sigma_text = (
                "" if sigma is None else f", sigma {sigma:.3g}{unit}" if sigma else ", held"
            )
            out.append(f"{name} = {values[k]:.9g}{unit}{sigma_text}")
        return out


def load_source(
    origin: SavedCalibration | Machine | Path | str, session: Path | None = None
) -> MachineSource:
    """Source from a calibration or its folder, a machine, a mechanism file or the name of a
    built-in machine.

    Raises InputError if ``origin`` is none of these.

    session : the calibration's session, for its cameras; by default it is searched around the
        folder.
    """
    calibration = loaded(origin)
    if isinstance(calibration, SavedCalibration):
        return _of_calibration(calibration, session)
    if isinstance(origin, Machine):
        name = f"{origin.name} in memory"
    elif str(origin) in catalogue():
        name = f"the built-in machine {origin}"
    else:
        name = Path(str(origin)).name
    return MachineSource(calibration, origin=name)


def loaded(origin: SavedCalibration | Machine | Path | str) -> SavedCalibration | Machine:
    """Calibration or machine as it is, or from a folder, a file in it, a mechanism file or a
    built-in machine's name.

    Raises InputError if ``origin`` is none of these.
    """
    if isinstance(origin, SavedCalibration | Machine):
        return origin
    path = given_path(origin, "a calibration's folder, a mechanism file or a machine's name")
    if str(origin) in catalogue() and not (path / CALIBRATION_DOCUMENT_FILE).is_file():
        return load_mechanism(str(origin))
    if (
        path.name == CALIBRATED_MECHANISM_FILE
        and (path.parent / CALIBRATION_DOCUMENT_FILE).is_file()
    ):
        path = path.parent  # the mechanism file of a calibration
    if path.is_dir() or path.name == CALIBRATION_DOCUMENT_FILE:
        return load(path)
    beside = path.is_file() and (path.parent / CALIBRATION_DOCUMENT_FILE).is_file()
    if beside and path.suffix not in (".yaml", ".yml"):
        raise InputError(
            "this file is neither a calibration nor a mechanism file",
            where=str(origin),
            expected="the calibration's folder, or its mechanism file",
            next_step=f"Name the folder, {path.parent}",
            code="calibration.other_file",
        )
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        raise InputError(
            "there is no such calibration and no such machine",
            found=str(origin),
            expected=closest(str(origin), catalogue())
            or "a folder that pkmcal calibrate wrote, a mechanism file, or"
            f" {listed(sorted(catalogue()), 20)}",
            code="machine.unknown",
        )
    return load_mechanism(path)


def _of_calibration(saved: SavedCalibration, session: Path | None) -> MachineSource:
    """Source of a calibrated machine with its cameras."""
    folder = saved.path.parent
    session_entry = saved.document.get("session") or {}
    session_words = " ".join(
        (
            "session",
            *(str(session_entry[key]) for key in ("folder", "digest") if key in session_entry),
        )
    )
    # intrinsics of the stations whose camera files are available
    files = {station.name: station.camera for station in saved.stations}
    cameras = {
        name: load_camera(value)
        for name, file in files.items()
        if (value := _camera_file(folder, file, _session_folder(saved, session))) is not None
    }
    sigma = {s.name: np.append(s.sigma_rotation, s.sigma_translation) for s in saved.stations}
    # a bed's position along itself is undetermined by heights: not a pose to export
    placed = [s for s in saved.stations if np.isfinite(sigma[s.name]).all()]
    bed_by, bed_sigma = _bed_uncertainty(saved)
    return MachineSource(
        machine=saved.machine,
        sigma=saved.sigma,
        cameras=MappingProxyType(cameras),
        T_base_camera=MappingProxyType({s.name: s.T_base_camera for s in placed}),
        sigma_camera=MappingProxyType({s.name: sigma[s.name] for s in placed}),
        headline=saved.verdict.headline,
        usable=saved.verdict.usable,
        origin=resolved(folder).name,
        covariance=saved.covariance,
        reasons=() if saved.verdict.usable else saved.verdict.reasons,
        calibrated=True,
        frames=saved.gauge,
        bed=_bed(saved),
        bed_by_parameters=bed_by,
        bed_sigma=bed_sigma,
        session=session_words if session_entry else "",
    )


def _bed(saved: SavedCalibration) -> float | None:
    """Height (m, base frame) of the platform's origin on a bed whose heights were measured.

    None without measured heights, or if their plane need not be level.
    """
    if saved.document.get("bed"):
        return saved.document["bed"].get("z")
    stations = (saved.document.get("session") or {}).get("stations") or {}
    targets = saved.document.get("targets") or []
    mounts = {one.get("name"): one.get("T_platform_target") for one in targets}
    for station in saved.stations:
        tracker = (stations.get(station.name) or {}).get("tracker") or {}
        mount = mounts.get(station.name)
        if tracker.get("level") is True and mount is not None:  # its table is one of heights
            target = np.array(mount)
            return -float(inverse(station.T_base_camera)[2, 3] + target[2, 3])
    return None


def _bed_uncertainty(saved: SavedCalibration) -> tuple[Array, float] | tuple[None, None]:
    """Derivative (P,) of the bed's height by the parameters, and its standard deviation beside
    them.

    The bed is the weighted mean of the heights that the machine has at the probed readings.
    """
    heights = [one for one in saved.document.get("heights") or () if one["used"]]
    if not heights:
        return None, None
    rows = [saved.configurations.index(one["configuration"]) for one in heights]
    weight = np.array([one["sigma"] for one in heights]) ** -2.0
    by = pose_by_parameters(saved.machine, saved.joints[rows], saved.T_base_platform[rows])[:, 5]
    return weight @ by / weight.sum(), float(weight.sum() ** -0.5)


def _session_folder(saved: SavedCalibration, session: Path | None) -> Path | None:
    """Folder of the session: as given, above the calibration, or beside it (as demo writes it).

    None if it is not found. Raises InputError if the given folder holds no session.
    """
    if session is not None:
        if not (session / SESSION_FILE).is_file():
            raise InputError(
                "there is no session here",
                where=str(session),
                expected=f"a {SESSION_FILE}",
                code="session.missing",
            )
        return session
    above = resolved(saved.path).parent.parent
    name = str((saved.document.get("session") or {}).get("folder", ""))
    for folder in (above, above / name):
        if legible(folder.name) == legible(name) and (folder / SESSION_FILE).is_file():
            return folder
    return None


def _camera_file(folder: Path, file: str, session: Path | None) -> Path | None:
    """Camera file of a station, as refined with the machine or as the session has it; None for
    trackers.
    """
    if Path(file).suffix == ".csv":
        return None
    refined = folder / written_camera(file)
    if refined.is_file():
        return refined
    given = None if session is None else session / file
    return given if given is not None and camera_path(given)[0].is_file() else None
