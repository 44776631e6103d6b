"""Files for people and other programs: maps, reports, pictures and parameters."""
