"""Pure functions of geometry: rigid motions, lines, cylinders and their edge planes."""
