"""What a minute, a megabyte and a splat are worth in one scene, measured on its own photographs."""
