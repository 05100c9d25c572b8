"""Statistics of splat files, and the proof that a file holds the splats it was made from."""
