"""What became of a flight, for statistics: events, sent poses and their errors, the outcome."""
