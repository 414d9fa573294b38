"""A calibrated machine held against new data: validation, hold-outs, and the watch for changes."""
