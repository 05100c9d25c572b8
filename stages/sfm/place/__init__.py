"""Where the scene is: levelling, metric scale, GPS, coordinate systems, markers."""
