"""Plots of the papers' tables."""
