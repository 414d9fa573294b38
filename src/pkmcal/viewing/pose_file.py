"""Station poses written back into session.yaml; nothing else in the file changes."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import resolved, with_numbers, write_bytes
from pkmcal.session.load import SESSION_FILE_NAME, Station
from pkmcal.viewing.overlay import place_of


class PoseFile:
    """session.yaml in the state in which this process last read or wrote it."""

    def __init__(self, folder: Path) -> None:
        self._path = resolved(folder) / SESSION_FILE_NAME
        self._last_bytes = self._path.read_bytes()
        self._lock = Lock()

    def write(self, station: Station, T_camera_base: Array) -> str:
        """Write a station's pose and return a sentence about it.

        Raises InputError for a file that is a symbolic link (as in a copy
        of somebody else's session), for a file that somebody else has changed since it was last
        read, and for a pose that cannot be edited by itself.
        """
        keys: tuple[str, ...] = ("stations", station.entry, "pose")
        if station.handheld:  # each image has a pose of its own, by its name after the entry's
            image = station.name.removeprefix(f"{station.entry}-")
            keys = (*keys[:2], "poses", image)
        # one writer at a time; the file must be the one that this page read or wrote last
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
                raise InputError(
                    f"cannot be read ({reason})", where=str(self._path), code="file.unreadable"
                ) from None
            # an edit of the user in the meantime must not be lost
            if now != self._last_bytes:
                raise InputError(
                    "the file was changed by somebody else since this page read it",
                    where=str(self._path),
                    next_step="Nothing was written. Start pkmcal view again, and put the machine"
                    " there once more",
                    code="session.changed",
                )
            entry = place_of(T_camera_base)
            text = with_numbers(
                now.decode("utf-8"), SESSION_FILE_NAME, keys, entry, with_parent=station.handheld
            )
            changed = text.encode("utf-8")
            if changed != now:
                write_bytes(self._path, changed)
            self._last_bytes = changed
        return f"The pose of {station.name} is in {SESSION_FILE_NAME}; nothing else in it changed."
