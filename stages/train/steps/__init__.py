"""One training step by backend: forward pass, loss, backward pass and Adam."""
