"""Least squares: batched Levenberg-Marquardt, robust weights, scaled ranks and inverses.

A problem has unknowns that all configurations share, x_a (na), and own unknowns (nuisance
parameters) of each of K configurations, x_b (d each). Residual rows are grouped by configuration::

                    x_a         x_b1      x_b2      ...       x_bK
      rows 1    | by_shared | by_own |         |         |         |
      rows 2    | by_shared |        | by_own  |         |         |
      ...       |    ...    |        |         |   ...   |         |
      rows K    | by_shared |        |         |         | by_own  |
      shared    | shared_by |        |         |         |         |     prior sigmas, gauge

with ``by_shared`` (B, K, r, na), ``by_own`` (B, K, r, d) and ``shared_by`` (c, na). B counts
independent runs: each has its own damping, acceptance and stop, and no loop goes over runs or
configurations.

Bottom to top: ``ranks`` and inverses of scaled matrices; ``elimination`` of the configurations' own
unknowns, a Schur complement; ``strips`` of rows that depend on few shared unknowns, and the normal
equations of all; ``search``, the damped steps and why they end. Beside them ``kernels``, the robust
weights, and ``marquardt``, steps of many small problems that share nothing.
"""
