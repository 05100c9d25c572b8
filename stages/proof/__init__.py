"""What is in a file of splats, and whether it is what it was made from."""
