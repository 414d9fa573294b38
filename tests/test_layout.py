"""Imports go one way: every module's imports against the table in docs/architecture.md."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "pkmcal"
FACES = {"__init__", "__main__"}


def rows() -> dict[str, int]:
    """Row of each package, from the table."""
    table = re.findall(r"^\| (\d+) \| (.+?) \|", (ROOT / "docs/architecture.md").read_text(), re.M)
    return {name: int(row) for row, cell in table for name in re.findall(r"`(\w+)`", cell)}


def file_of(name: str) -> Path | None:
    """The file of a module or package, by its dotted name."""
    first, *rest = name.split(".")
    stem = SOURCE.joinpath(*rest)
    files = (stem.with_suffix(".py"), stem / "__init__.py") if first == "pkmcal" and rest else ()
    return next((path for path in files if path.is_file()), None)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def import_nodes(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """All import statements of a file, at its top or inside its functions."""
    return [n for n in ast.walk(parsed(path)) if isinstance(n, ast.Import | ast.ImportFrom)]


def imports(path: Path) -> set[Path]:
    """Files of the package that a file imports, at its top or inside its functions."""
    actual_names: set[Path | None] = set()
    for node in import_nodes(path):
        if isinstance(node, ast.Import):
            actual_names |= {file_of(alias.name) for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            whole = file_of(node.module)
            actual_names |= {
                file_of(f"{node.module}.{alias.name}") or whole for alias in node.names
            }
    return {other for other in actual_names if other is not None}


@cache
def arrows() -> dict[Path, set[Path]]:
    """Imports of every file; parsed when first needed, not when tests are collected."""
    return {path: imports(path) for path in SOURCE.rglob("*.py")}


def package(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def test_the_table_names_every_package():
    assert {package(path) for path in arrows()} - FACES == rows().keys()
    assert len(list(SOURCE.glob("*.py"))) <= 8


def test_packages_import_only_from_rows_above():
    order = rows()
    wrong = [
        f"{path.relative_to(SOURCE)} imports {other.relative_to(SOURCE)}"
        for path, others in arrows().items()
        if package(path) not in FACES
        for other in others
        if package(other) != package(path) and order.get(package(other), 99) >= order[package(path)]
    ]
    assert wrong == []


def test_no_files_import_each_other_in_a_circle():
    remainder = {path: set(others) - {path} for path, others in arrows().items()}
    while ends := [path for path, others in remainder.items() if not others & remainder.keys()]:
        for path in ends:
            del remainder[path]
    assert sorted(str(path.relative_to(SOURCE)) for path in remainder) == []


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def test_private_names_are_used_in_their_own_file_and_nowhere_else():
    """Two checks that neither the type checker nor ruff has: a function without a caller, and the
    use of another file's private names.
    """
    wrong: list[str] = []
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree, where = parsed(path), path.relative_to(SOURCE)
        made = (n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef))
        names = (node.name for node in made if not node.decorator_list and is_private(node.name))
        alone = (name for name in names if len(re.findall(rf"\b{name}\b", text)) == 1)
        wrong += (f"{where}: nobody uses {name}" for name in alone)
        taken = (n for n in import_nodes(path) if isinstance(n, ast.ImportFrom))
        names = (alias.name for node in taken for alias in node.names)
        wrong += (f"{where} imports {name}" for name in names if is_private(name))
    assert wrong == []
