"""Files that people and other programs read: maps, reports, pictures and parameters."""
