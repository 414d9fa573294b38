"""Calibrated machines tested on new data: validation, holdouts, and detection of changes."""
