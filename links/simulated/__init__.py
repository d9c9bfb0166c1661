"""A simulated world and sensors that give the same bytes as the hardware."""
