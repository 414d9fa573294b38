"""The commands, one a module; heavy imports stand inside them, so that help comes at once."""
