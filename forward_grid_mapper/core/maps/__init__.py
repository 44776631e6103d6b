"""From the map that the search found, or from the readings alone, to the final maps."""
