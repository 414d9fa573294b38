"""Reproduction of [A], [B] and [C], a module each: experiment, figures of the paper, and table."""
