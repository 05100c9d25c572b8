"""Known cameras instead of structure from motion.

In reading order: `reconstruct` (all steps), `match_cameras` (cameras to photographs, by name),
`pinhole_views` (undistorted pictures), `epipolar` (do matches fit the poses?), `triangulation`
(matches and points, in the worker process), `points` (which points are used).
"""
