"""Stage 7: writes the assets, reads each back and compares it."""
