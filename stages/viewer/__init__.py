"""Pages of finished and of training scenes, their local server, camera paths and films.

`site` says which files `server` serves. `live_training` and `live_page` show training. For pictures
and films `render_cameras` makes the cameras, by `camera_paths` and `orbit`, and `sinks` writes what
was drawn.
"""
