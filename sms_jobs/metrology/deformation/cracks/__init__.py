"""Lines where displacement jumps, and by how much."""
