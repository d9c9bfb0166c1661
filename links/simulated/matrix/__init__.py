"""Many simulated flights: the scenario matrix, how it is generated, and a comparison with real captures."""
