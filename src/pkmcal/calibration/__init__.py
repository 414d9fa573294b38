"""From a session to a calibrated machine: recognise, look and identify in turns, judge, save."""
