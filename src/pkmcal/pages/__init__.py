"""What pages are made of: the page of all commands, charts, plots, photographs drawn over."""
