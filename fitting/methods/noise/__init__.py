"""What residuals say of their noise: shared by neighbours, or not the same at all points."""
