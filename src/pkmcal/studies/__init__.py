"""Monte-Carlo studies: one engine, and settings of the engine for a design that is varied."""
