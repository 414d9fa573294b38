"""Calibration boards: detection in images, poses as measurements, and camera calibration from
boards.
"""
