"""Files in and out: YAML with line numbers, schemas, CSV tables, outputs whole or not at all."""

from pkmcal.files.json_files import json_text, plain, read_json
from pkmcal.files.tables import Table, csv_text, read_csv
from pkmcal.files.text import closest, read_text, shown, wanted_file
from pkmcal.files.validation import Schema, field_path, validate
from pkmcal.files.writing import (
    check_own_folder,
    check_writable,
    staged_folder,
    write_bytes,
    write_folder,
    write_text,
)
from pkmcal.files.yaml_files import Document, Keys, parse_yaml, read_yaml, yaml_text
from pkmcal.wording import listed

__all__ = [
    "Document",
    "Keys",
    "Schema",
    "Table",
    "check_own_folder",
    "check_writable",
    "closest",
    "csv_text",
    "field_path",
    "json_text",
    "listed",
    "parse_yaml",
    "plain",
    "read_csv",
    "read_json",
    "read_text",
    "read_yaml",
    "shown",
    "staged_folder",
    "validate",
    "wanted_file",
    "write_bytes",
    "write_folder",
    "write_text",
    "yaml_text",
]
