"""How episodes are shown: as films and pictures, in a window, in a browser; and the look of all figures."""
