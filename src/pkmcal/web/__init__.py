"""Viewer: the documents that it draws, its pages, and the server of pages on this computer."""
