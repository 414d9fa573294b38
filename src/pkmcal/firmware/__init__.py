"""Firmwares of delta printers: configurations read and written, and sessions made from them."""
