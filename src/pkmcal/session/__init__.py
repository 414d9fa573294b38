"""A session on disk: its files, photographs, readings and tables, loaded and checked as a whole."""
