"""Is a machine still as calibrated: chi-square tests on new data, behind ``pkmcal watch``."""
