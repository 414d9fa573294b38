"""A pose written back into session.yaml, of which nothing else changes."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import resolved, with_numbers, write_bytes
from pkmcal.session.load import SESSION_FILE_NAME, Station
from pkmcal.view.overlay import place_of


class PoseFile:
    """session.yaml as it was read when the page was opened, and written since."""

    def __init__(self, folder: Path) -> None:
        self._path = resolved(folder) / SESSION_FILE_NAME
        self._last_bytes = self._path.read_bytes()
        self._lock = Lock()

    def write(self, station: Station, T_camera_base: Array) -> str:
        """Write a station's pose; returns what was written, in words.

        Raises InputError for a camera that is held by hand, for a file that is a link, as in
        somebody else's session, or that somebody else has changed meanwhile, and where the pose
        cannot be changed by itself.
        """
        keys = ("stations", station.entry, "pose")
        if station.handheld:
            raise InputError(
                "a camera that is held by hand has no one pose to be written",
                where=f"{SESSION_FILE_NAME}, {'.'.join(keys[:2])}",
                next_step="Every such photograph is placed when you calibrate",
            )
        with self._lock:
            if self._path.is_symlink():
                raise InputError(
                    "this file is a link to another one, and nothing is written through links",
                    where=str(self._path),
                    found=f"a link to {self._path.readlink()}",
                    next_step="Nothing was written. Put a copy of the file in the link's place",
                )
            try:
                now = self._path.read_bytes()
            except OSError as error:
                reason = error.strerror
                raise InputError(f"cannot be read ({reason})", where=str(self._path)) from None
            if now != self._last_bytes:
                raise InputError(
                    "the file was changed by somebody else since this page read it",
                    where=str(self._path),
                    next_step="Nothing was written. Start pkmcal view again, and put the machine"
                    " there once more",
                )
            entry = place_of(T_camera_base)
            changed = with_numbers(now.decode("utf-8"), SESSION_FILE_NAME, keys, entry).encode(
                "utf-8"
            )
            if changed != now:
                write_bytes(self._path, changed)
            self._last_bytes = changed
        return f"The pose of {station.name} is in {SESSION_FILE_NAME}; nothing else in it changed."
