"""Files of cameras that other programs know: one module a format, read and write.

In reading order: `camera_file` (what every reader returns), `camera_formats` (the list of formats,
and how to add one), `lens` and `undistortion` (camera models), then the formats: `colmap` with
`colmap_records`, `nerfstudio`, `blender`, `llff`, `opensfm`, `bundler`, `metashape`, `realityscan`,
`realityscan_xmp`, `opf`, `arkit`.
"""
