"""Local web page that overlays the machine on a session's images."""
