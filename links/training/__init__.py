"""Training of the detector's model from the candidate logs of runs (`grd train-detector`)."""
