"""How good a picture is, and what each splat is worth to it."""
