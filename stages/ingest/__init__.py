"""Stage 1: photographs, videos and panoramas -> `Capture`: upright pictures, EXIF, masks, depth.

In reading order:
- `settings`, `stage`: the options; the stage from its input to its files.
- What a folder holds: `sources`, `find`, and by names `masks` and `depth_files`.
- A photograph: `decode`, `tiff`, `exif`, `gps`, `colour`.
- A 360-degree picture: `panorama` (recognises it), `faces` (cuts it).
- A video: `video_frames` (all steps), `video`, `video_colour`, `frame_selection`.
- `masking` applies masks, `quality` measures pictures, `write` and `capture_file` write them, and
  `advice` warns.
- For structure from motion: `fisheye_faces` (of known cameras), `image_circle`.
"""
