"""Keys of every JSON document that users' programs read, held in document_keys.json.

A document that gains, loses or renames a key fails its test; where that is meant, write the keys
again with ``UPDATE_DOCUMENT_KEYS=1 pytest ...`` and say so in CHANGELOG.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

KEYS_FILE = Path(__file__).with_suffix(".json")
NAMED = {
    "files", "versions", "timings", "facts", "mechanism", "session", "values", "photographs",
    "provenance",
}  # fmt: skip
"""Keys below which the keys are names of files, parameters or packages, or those of another
file."""


def key_paths(value: object, path: str = "") -> Iterator[str]:
    """Paths of all keys in a JSON value, such as ``stations[].name``."""
    if isinstance(value, dict):
        for key, item in value.items():
            below = f"{path}.{key}" if path else key
            yield below
            if key not in NAMED:
                yield from key_paths(item, below)
    if isinstance(value, list):
        for item in value:
            yield from key_paths(item, f"{path}[]")


def assert_keys(name: str, document: object) -> None:
    """The document has just the keys that are held under ``name``."""
    written = sorted(set(key_paths(document)))
    held = json.loads(KEYS_FILE.read_text(encoding="utf-8")) if KEYS_FILE.is_file() else {}
    if os.environ.get("UPDATE_DOCUMENT_KEYS"):
        text = json.dumps({**held, name: written}, indent=1, sort_keys=True)
        KEYS_FILE.write_text(text + "\n", encoding="utf-8")
        return
    assert written == held[name]
