"""Structure from motion by COLMAP, its quality gates and fallbacks, and where splats are seeded.

Without known cameras (`stages.sfm`):
- `fallbacks` lists the configurations and tries them; `attempt_runner` runs one of them as jobs
  (`job`) in worker processes (`process`, `worker`), or in `chunks`;
- in the worker: `features` (SIFT), then pairs by `retrieval` over a `vocabulary` of visual words
  and `pairs`, `matching` with `descriptor_matching` and two-view geometry, then `mapping`;
- where SIFT leaves photographs out: `learned` adds `learned_features` and `learned_matching`, whose
  weights `learned_weights` finds;
- `sparse_model` holds the result with its statistics (`view_graph`, `epipolar`), `gates` check
  them, and `acceptance` decides which model is used.

With known cameras: `match_cameras`, `known_cameras`, `known_cameras_worker` and `known_points`;
`pinhole_views` cuts wide fisheyes into faces.

Both end in `finish`: `levelling`, `metric_scale` (`markers`) and `undistorted_images`; then `light`
measures exposure and vignetting, and `reconstruction_files` stores the result.
"""
