"""Components of HTML pages: the page template of all commands, charts, plots, image overlays."""
