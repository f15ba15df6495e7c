"""Pictures and mesh files for people to look at."""
