"""How episodes are shown: as films and pictures, and in a browser."""
