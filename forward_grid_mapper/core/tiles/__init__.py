"""A map in tiles: each is searched with the readings that reach into it, while the others are fixed."""
