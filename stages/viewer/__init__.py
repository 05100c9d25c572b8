"""Pages of finished and of training scenes, their local server, camera paths and films."""
