"""Model only what a scene requires: cut what does not pay, fine-tune, and look whether it held."""
