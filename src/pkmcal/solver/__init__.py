"""Least squares: batched Levenberg-Marquardt, robust weights, scaled ranks and inverses.

A problem has unknowns that all configurations share, x_a (na), and unknowns of each
configuration alone, x_b (d each). Residual rows are grouped by configuration, so the Jacobian
is ``by_shared`` (B, K, r, na) and ``by_own`` (B, K, r, d); rows that touch shared unknowns only
(drawing values, gauge) stand beside them. B counts independent runs: each has its own damping,
acceptance and stop, and no loop goes over runs or configurations.

Bottom to top: ``ranks`` and inverses of scaled matrices; ``elimination`` of the configurations' own
unknowns; ``strips`` of rows that depend on few shared unknowns, and the normal equations of all;
``search``, the damped steps and why they end. Beside them ``kernels``, the robust
weights, and ``marquardt``, steps of many small problems that share nothing.
"""
