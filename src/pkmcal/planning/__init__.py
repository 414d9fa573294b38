"""Optimal design of the next measurements: predicted information of configurations and stations."""
