"""Measurements to parameters, with their uncertainty."""
