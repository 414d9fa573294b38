"""Whether a calibration holds on data that it did not see: predictions, paths, hold-outs."""
