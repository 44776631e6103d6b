"""What every other layer uses: errors, the grid, the parameter table, and readings in the map frame."""
