"""Intrinsic calibration of a camera from images of a board, and the choice of its model."""
