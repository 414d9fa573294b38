"""Edges and background features from images, and localization of stations."""
