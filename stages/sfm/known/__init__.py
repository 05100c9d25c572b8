"""Known cameras: assigned by name, checked against matches, with points."""
