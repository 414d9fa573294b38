"""JSON files: every number finite, matrices row by row so that people can read them too."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files.text import read_text, shown
from pkmcal.files.yaml_files import Document

_WIDEST = 160
"""Characters up to which a list or an object stays on one line."""


def plain(value: Any) -> Any:
    """Arrays, tuples and NumPy numbers as JSON has them; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def json_text(value: Any) -> str:
    """Plain data as JSON text; short parts and rows of numbers stay on one line each."""
    return _text(plain(value), "") + "\n"


def _text(value: Any, indent: str) -> str:
    line = _line(value)
    if not isinstance(value, dict | list) or _is_row(value):
        return line
    nested = any(isinstance(item, dict | list) for item in _items(value))
    if len(line) <= _WIDEST and not nested:
        return line
    inner = indent + " "
    parts = [_text(item, inner) for item in _items(value)]
    if isinstance(value, dict):
        parts = [f"{_line(key)}: {part}" for key, part in zip(value, parts, strict=True)]
    opened, closed = "{}" if isinstance(value, dict) else "[]"
    return f"{opened}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{closed}"


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _items(value: dict[str, Any] | list[Any]) -> list[Any]:
    return list(value.values()) if isinstance(value, dict) else value


def _is_row(value: Any) -> bool:
    """A row of a matrix or a table, which is easier to read on one line however long it is."""
    return isinstance(value, list) and all(isinstance(v, int | float | None) for v in value)


def read_json(path: Path | str, label: str | None = None) -> Document:
    """Read a JSON file whose top is an object; its values have no lines."""
    path = Path(path)
    label = label or path.name
    try:
        data = json.loads(read_text(path, label), parse_constant=_refuse)
    except RecursionError:
        raise InputError("the file is nested too deeply to be read", where=label) from None
    except json.JSONDecodeError as error:
        raise InputError(
            f"not valid JSON ({error.msg})", where=f"{label}, line {error.lineno}"
        ) from None
    except ValueError as error:
        raise InputError("not valid JSON", where=label, found=str(error)) from None
    if not isinstance(data, dict):
        raise InputError("the top of the file is not an object", where=label, found=shown(data))
    return Document(path, label, data, {})


def _refuse(constant: str) -> float:
    raise ValueError(constant)
