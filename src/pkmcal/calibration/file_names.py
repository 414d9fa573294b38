"""Names of a calibration's folder and files; importing them loads nothing else."""

from __future__ import annotations

CALIBRATED_MECHANISM_FILE, CALIBRATION_DOCUMENT_FILE, CALIBRATION_REPORT_FILE = (
    "mechanism.yaml",
    "calibration.json",
    "report.html",
)
CALIBRATION_FOLDER = "calibration"
"""Folder of a session into which `pkmcal calibrate` writes by default."""
