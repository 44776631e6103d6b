"""What every other layer uses: errors, the grid, the parameter table, and readings placed in the map frame."""
