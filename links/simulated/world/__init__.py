"""What a simulated scene contains: meshes, ray casting, moving bodies, paths, flight dynamics, weather and sky."""
