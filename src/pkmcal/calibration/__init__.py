"""From a session to a calibrated machine: localize, measure and estimate in turns, judge, save."""
