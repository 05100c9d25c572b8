"""A server of this machine only, and what it shows: a finished scene, or one in training."""
