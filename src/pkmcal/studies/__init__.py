"""Monte-Carlo studies: one engine, and the papers' own simulations as settings of it."""
