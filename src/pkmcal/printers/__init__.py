"""Calibration sessions of delta printers, made from the data that their firmware holds."""
