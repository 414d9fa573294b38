"""Checks of a session before its calibration, and the scatter of its repeated measurements."""
