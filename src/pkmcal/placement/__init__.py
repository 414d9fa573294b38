"""Where a machine and its cameras stand in a session, and the edges that these cameras measure.

`configurations` draws poses of the platform, `stations` places cameras, `default_camera` is the
camera without a file, and `edges` predicts the measured edges, with noise where a simulation needs
it. Plans, checks, simulations and control use all of them.
"""
