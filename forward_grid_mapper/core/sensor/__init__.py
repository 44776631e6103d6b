"""One reading: its cone on the grid, the density of its range, surface normals, and the forward sensor model."""
