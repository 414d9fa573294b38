"""A session on disk: its images, readings, cameras and tables, loaded and checked as a whole."""
