"""A session's photographs with the machine laid over, on a page of this computer."""
