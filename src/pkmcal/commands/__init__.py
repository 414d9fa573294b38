"""Commands, one in each module; heavy imports are inside the functions, so that help is quick."""
