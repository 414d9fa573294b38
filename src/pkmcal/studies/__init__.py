"""Monte-Carlo studies: one engine, and the papers' simulations as settings of the engine."""
