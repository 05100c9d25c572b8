"""Stage 2: `Capture` -> `Reconstruction`: structure from motion by COLMAP, or known cameras.

Without known cameras (`stage`):
- `checks.fallbacks` lists the configurations and tries them; `checks.attempt_runner` runs one of
  them as jobs (`worker.job`) in worker processes (`worker.process`), or in `worker.chunks`;
- in the worker: `features` (SIFT), then pairs by `retrieval` over a `vocabulary` of visual words
  and `pairs`, `matching` with `descriptor_matching` and two-view geometry, then `mapping`;
- where SIFT leaves photographs out: `learned`;
- `worker.sparse_model` holds the result with its statistics, `checks.gates` check them, and
  `checks.acceptance` decides which model is used.

With known cameras: `known`.

Both end in `finish`: `place.levelling`, `place.metric_scale` and `undistorted_images`; then `light`
measures exposure and vignetting, and `reconstruction_files` stores the result.
"""
