"""Boards in photographs: found, measured as poses; cameras calibrated from them."""
